"""MOPO on a robot that falls: where its trajectories end, and what the ring makes of it."""

import dataclasses

import numpy as np
import pytest
import torch

from components.algorithms.parts.falls import healthy_ranges
from components.algorithms.parts.model_buffer import ModelBuffer
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from tests.components.algorithms.stacks import learner
from tests.components.robot import HEALTHY, LIMIT, make_robot_log
from tests.components.synthetic import CPU, make_log

LOG = make_robot_log()


def with_ranges(log: OfflineDataset, **healthy: list) -> OfflineDataset:
    """The log on whose card other ranges stand."""
    dynamics = {**log.card.dynamics, "healthy": healthy}
    return dataclasses.replace(log, card=dataclasses.replace(log.card, dynamics=dynamics))


def test_healthy_ranges_are_scaled_like_what_policies_see() -> None:
    data = LaneData([LOG, make_robot_log("other", seed=5)], CPU)
    found = healthy_ranges(data)
    assert found is not None
    scaling = data.frame_scaling
    low, high = (side * scaling.scale[:, None] + scaling.mean[:, None] for side in found)
    assert low.shape == (2, 1, 3)
    assert HEALTHY == {"tilt": [-LIMIT, LIMIT], "speed": [None, 50.0]}
    # scaled and unscaled in single precision
    torch.testing.assert_close(low[:, 0, 0], torch.full((2,), -LIMIT))
    torch.testing.assert_close(high[:, 0, :2], torch.tensor([[LIMIT, 50.0]] * 2))
    assert torch.equal(low[:, 0, 1:], torch.full((2, 2), -torch.inf))
    assert torch.equal(high[:, 0, 2], torch.full((2,), torch.inf))


def test_machines_that_never_fall_and_wrong_names() -> None:
    assert healthy_ranges(LaneData([make_log()], CPU)) is None
    assert healthy_ranges(LaneData([with_ranges(LOG)], CPU)) is None
    with pytest.raises(ValueError, match="healthy range of 'height', which is no feature"):
        healthy_ranges(LaneData([with_ranges(LOG, height=[0.7, None])], CPU))


@torch.no_grad()
def test_trajectories_end_at_their_first_fall() -> None:
    made = learner("mopo", [LOG, make_robot_log("other", seed=5)], [0, 1], rollouts=200)
    drawn = {name: value.clone() for name, value in made._rollout_streams.at(0).items()}
    made._roll_out(0)
    scaling = made._data.frame_scaling
    frames = torch.stack([step.frames for step in made._unroll(drawn)])  # [T, L, B, F]
    tilt = (frames * scaling.scale[:, None] + scaling.mean[:, None])[..., 0]
    ends = []
    for lane, b in np.ndindex(2, 200):
        fallen = [abs(float(t)) >= LIMIT for t in tilt[:, lane, b]]
        ends.append(fallen.index(True) if any(fallen) else 4)
        assert made._buffer.ended[lane, b] == ends[-1]
    assert set(ends) == {0, 1, 2, 3, 4}, "every ending must occur for this test to say something"


def test_steps_up_to_an_end_are_drawn_equally_often_and_none_behind_it() -> None:
    buffer = ModelBuffer(LaneData([LOG], CPU), 3, 4)
    numbers = torch.arange(12.0).view(4, 1, 3)  # of step t and trajectory n: 3 t + n
    frames = numbers[..., None].expand(-1, -1, -1, 3)
    ended = torch.tensor([[1, 4, 3]])  # at the second step, never, at the last
    buffer.write(0, torch.zeros(1, 3).long(), [*frames], [*frames[..., :2]], [*numbers], ended)
    assert [int(buffer.count(places)) for places in range(4)] == [0, 2, 6, 10]
    batch = buffer.batch(torch.arange(10)[None])
    first, second, third = [0, 3], [1, 4, 7, 10], [2, 5, 8, 11]
    assert batch.rewards[0].tolist() == first + second + third
    assert torch.equal(batch.next_observations, batch.rewards[..., None].expand(-1, -1, 3))
    assert batch.observations[0, [1, 3, 7], 0].tolist() == [0.0, 1.0, 2.0]
    assert batch.continues[0].tolist() == [1, 0, 1, 1, 1, 1, 1, 1, 1, 0]
    # Another roll-out in its place is counted anew, also in a ring that is restored.
    other = ModelBuffer(LaneData([LOG], CPU), 3, 4)
    other.load_state_dict(buffer.state_dict())
    for ring in (buffer, other):
        assert int(ring.count(3)) == 10
        assert torch.equal(ring.batch(torch.arange(10)[None]).rewards, batch.rewards)
        ring.write(
            0,
            torch.zeros(1, 1).long(),
            [*frames[:, :, :1]],
            [*frames[:, :, :1, :2]],
            [*numbers[:, :, :1]],
        )
        assert [int(ring.count(places)) for places in range(4)] == [0, 4, 8, 12]


@torch.no_grad()
def test_a_learner_draws_every_transition_equally_often() -> None:
    """Evenly spread numbers hit each transition of a half-filled ring the same number of times."""
    made = learner("mopo", [LOG, make_robot_log("other", seed=5)], [0, 1], rollouts=50)
    made._roll_out(0)
    buffer, lengths = made._buffer, made._buffer.ended[:, :50].clamp(max=3) + 1
    assert lengths.sum() < 2 * 50 * 4, "some must have fallen"
    numbers = torch.zeros(2, 3 * 200, dtype=torch.float64)
    totals = lengths.sum(dim=1)
    for lane, total in enumerate(totals.tolist()):
        numbers[lane, : 3 * total] = (torch.arange(3 * total) + 0.5) / (3 * total)
    drawn = {name: value for name, value in made._streams.at(0).items() if name != "virtual"}
    rewards = made._batch(drawn | {"virtual": numbers}, 0).rewards[:, made._config.logged :]
    for lane, total in enumerate(totals.tolist()):
        valid = torch.arange(4) < lengths[lane, :, None]
        stored = buffer.rewards[lane, :50][valid].repeat_interleave(3)
        assert torch.equal(rewards[lane, : 3 * total], stored)
