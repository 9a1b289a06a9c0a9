"""The memory: rows as they were, lane by lane, on the device and in the files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from components.core.integrity import DamagedFileError
from components.experts.replay import Replay, replayed_episodes

CPU = torch.device("cpu")
LANES, STEPS = 2, 5


def numbers(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def filled(files: list[Path], steps: int = STEPS) -> Replay:
    replay = Replay(LANES, 8, 3, 2, CPU, files)
    for n in range(steps):
        fallen = np.array([n == 1, n == 3])
        seen, after = numbers(n, LANES, 3), numbers(100 + n, LANES, 3)
        replay.append(seen, numbers(200 + n, LANES, 2), numbers(300 + n, LANES), fallen, after)
    return replay


def test_batches_hold_what_happened() -> None:
    replay = filled([])
    assert replay.count == STEPS
    batch = replay.batch(torch.tensor([[4, 1, 1], [0, 3, 2]]))
    for lane, position, n in ((0, 0, 4), (0, 2, 1), (1, 0, 0), (1, 1, 3)):
        for values, seed, shape in (
            (batch.observations, n, (LANES, 3)),
            (batch.next_observations, 100 + n, (LANES, 3)),
            (batch.actions, 200 + n, (LANES, 2)),
            (batch.rewards, 300 + n, (LANES,)),
        ):
            expected = numbers(seed, *shape)[lane].astype(np.float32)
            np.testing.assert_array_equal(values[lane, position].numpy(), expected)
    assert batch.continues.tolist() == [[1.0, 0.0, 0.0], [1.0, 0.0, 1.0]]
    np.testing.assert_array_equal(
        replay.actions(np.array([2, 4])),
        [numbers(202, LANES, 2)[0].astype(np.float32), numbers(204, LANES, 2)[1].astype("f4")],
    )


def test_a_checkpointed_count_is_restored_and_what_came_after_is_overwritten(
    tmp_path: Path,
) -> None:
    files = [tmp_path / f"{lane}" for lane in range(LANES)]
    whole = filled(files)
    again = Replay(LANES, 8, 3, 2, CPU, files)
    again.restore(3, filled([tmp_path / f"short{lane}" for lane in range(LANES)], 3).digests())
    assert again.count == 3
    index = torch.tensor([[0, 1, 2], [2, 0, 1]])
    assert torch.equal(again.batch(index).observations, whole.batch(index).observations)
    new = numbers(9, LANES, 3)
    again.append(new, new[:, :2], new[:, 0], np.zeros(LANES, dtype=np.bool_), new)
    last = Replay(LANES, 8, 3, 2, CPU, files)
    last.restore(4, again.digests())
    newest = last.batch(torch.tensor([[3], [3]])).observations[:, 0]
    np.testing.assert_array_equal(newest.numpy(), new.astype(np.float32))


def test_one_lane_can_go_on_without_the_other(tmp_path: Path) -> None:
    files = [tmp_path / f"{lane}" for lane in range(LANES)]
    whole = filled(files)
    alone = Replay(1, 8, 3, 2, CPU, files[1:])
    alone.restore(STEPS, whole.digests()[1:])
    index = torch.tensor([[0, 4]])
    assert torch.equal(alone.batch(index).actions[0], whole.batch(index.expand(2, 2)).actions[1])


@pytest.mark.parametrize(
    ("damage", "said"), [("short", "fewer transitions than"), ("flipped", "other transitions than")]
)
def test_a_damaged_file_is_named(tmp_path: Path, damage: str, said: str) -> None:
    files = [tmp_path / f"{lane}" for lane in range(LANES)]
    digests = filled(files).digests()
    content = bytearray(files[0].read_bytes())
    content[40] ^= 1
    files[0].write_bytes(content if damage == "flipped" else content[:-1])
    with pytest.raises(DamagedFileError, match=f"0 holds {said}.* its checkpoint") as caught:
        Replay(LANES, 8, 3, 2, CPU, files).restore(STEPS, digests)
    assert caught.value.path == files[0]


def test_episodes_are_those_that_were_collected(tmp_path: Path) -> None:
    """They end with a fall, at the time limit of two steps, and with the last row."""
    filled([tmp_path / f"{lane}" for lane in range(LANES)])
    for lane, (lengths, fallen) in enumerate(
        (([2, 2, 1], [True, False, False]), ([2, 2, 1], [False, True, False]))
    ):
        rows = np.fromfile(tmp_path / f"{lane}", np.float32).reshape(STEPS, -1)
        episodes = replayed_episodes(rows, 3, 2, horizon=2)
        assert [episode.steps for episode in episodes] == lengths
        assert [episode.terminated for episode in episodes] == fallen
        for n, last in ((0, False), (1, True), (4, True)):
            episode, step = episodes[n // 2], n % 2
            np.testing.assert_array_equal(
                episode.frames[step], numbers(n, LANES, 3)[lane].astype("f4")
            )
            np.testing.assert_array_equal(
                episode.actions[step], numbers(200 + n, LANES, 2)[lane].astype("f4")
            )
            assert episode.rewards[step] == np.float32(numbers(300 + n, LANES)[lane])
            if last:
                after = numbers(100 + n, LANES, 3)[lane].astype("f4")
                np.testing.assert_array_equal(episode.frames[-1], after)
    [whole] = replayed_episodes(rows[:1], 3, 2, horizon=9)
    assert whole.steps == 1
    assert not whole.terminated, "what follows the last row is not known"
