"""The ring of virtual trajectories: its transitions are those of a plain loop over frames."""

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.mopo import Config
from components.algorithms.parts.model_buffer import ModelBuffer
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from tests.components.synthetic import CPU, make_log

HISTORY, STEPS, LANES, EACH = 3, 40, 2, 7
LOGS = [make_log(), make_log("other", seed=5, explore=0.2)]
# The first rows of episodes, whose histories repeat their first frame, are among them.
STARTS = torch.tensor([[0, 1, 2, 40, 41, 77, 239], [239, 80, 0, 5, 5, 160, 2]])


def filled(length: int, rounds: int, kept: int) -> tuple[ModelBuffer, list[dict[str, Tensor]]]:
    """A ring after some rounds, and what was written in each."""
    generator = torch.Generator().manual_seed(length)
    buffer = ModelBuffer(LaneData(LOGS, CPU, 1e-3), kept * EACH, length)
    written = []
    for number in range(rounds):
        shape = (length, LANES, EACH)
        made = {
            "start": (STARTS + number) % 240,
            "frames": torch.randn(*shape, 6, generator=generator),
            "actions": torch.rand(*shape, 3, generator=generator),
            "rewards": torch.randn(*shape, generator=generator),
        }
        buffer.write(
            number % kept * EACH,
            made["start"],
            list(made["frames"]),
            list(made["actions"]),
            list(made["rewards"]),
        )
        written.append(made)
    return buffer, written


def scaled_frames(log: OfflineDataset) -> np.ndarray:
    """All frames in standard units, in double precision."""
    frames = log.frames.astype(np.float64)
    deviation = frames.std(axis=0) + 1e-3
    deviation[0] = 1.0  # the setpoint never changes
    return (frames - frames.mean(axis=0)) / deviation


def frames_before(log: OfflineDataset, row: int) -> list[np.ndarray]:
    """The recorded history at a transition, oldest first."""
    episode, step = divmod(row, STEPS)
    scaled = scaled_frames(log)[episode * (STEPS + 1) :]
    return [scaled[max(step - lag, 0)] for lag in reversed(range(HISTORY))]


def seen(frames: list[np.ndarray]) -> np.ndarray:
    """The observation after some frames: the last ones, newest first."""
    return np.concatenate(frames[::-1][:HISTORY])


@pytest.mark.parametrize("length", [1, 2, 3, 5])
@pytest.mark.parametrize(("rounds", "kept"), [(1, 3), (3, 3), (5, 3), (4, 1)])
def test_transitions_are_those_of_a_plain_loop(length: int, rounds: int, kept: int) -> None:
    """Of every step of every trajectory, in rings half full, full, and written over."""
    buffer, written = filled(length, rounds, kept)
    count = min(rounds, kept) * EACH * length
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    batch = buffer.batch(torch.stack([order, order.flip(0)]))
    assert batch.continues.tolist() == [[1.0] * count] * LANES
    for lane, numbers in enumerate((order, order.flip(0))):
        for i, number in enumerate(numbers.tolist()):
            place, t = divmod(number, length)
            slot, n = divmod(place, EACH)
            latest = max(r for r in range(rounds) if r % kept == slot)
            source = {
                name: value[:, lane, n] if name != "start" else value[lane, n]
                for name, value in written[latest].items()
            }
            frames = frames_before(LOGS[lane], int(source["start"]))
            frames += list(source["frames"][: t + 1].double().numpy())
            # float32 scaling of the recorded frames
            np.testing.assert_allclose(batch.observations[lane, i], seen(frames[:-1]), atol=1e-5)
            np.testing.assert_allclose(batch.next_observations[lane, i], seen(frames), atol=1e-5)
            assert torch.equal(batch.actions[lane, i], source["actions"][t])
            assert batch.rewards[lane, i] == source["rewards"][t]


def test_contents_are_state_with_the_lane_axis_first() -> None:
    buffer, _ = filled(4, 2, 3)
    state = {name: tensor.clone() for name, tensor in buffer.state_dict().items()}
    assert {name: tuple(tensor.shape) for name, tensor in state.items()} == {
        "start": (2, 21),
        "frames": (2, 21, 4, 6),
        "actions": (2, 21, 4, 3),
        "rewards": (2, 21, 4),
        "ended": (2, 21),
    }
    other = ModelBuffer(LaneData(LOGS, CPU, 1e-3), 21, 4)
    other.load_state_dict(state)
    index = torch.arange(56).expand(2, -1)
    ours, theirs = buffer.batch(index), other.batch(index)
    assert torch.equal(ours.next_observations, theirs.next_observations)
    assert torch.equal(ours.rewards, theirs.rewards)


def test_five_lanes_of_the_default_size_take_a_quarter_of_a_gigabyte() -> None:
    buffer, _ = filled(Config().rollout_length, 1, 1)
    a_trajectory = sum(t.numel() * t.element_size() for t in buffer.buffers()) / (LANES * EACH)
    default = Config()
    assert a_trajectory * 5 * default.retained_rollouts * default.rollouts < 270e6
