"""Logs continued after a fall, by hand."""

import numpy as np

from components.data.absorbing_states import with_absorbing_states
from components.data.dataset import OfflineDataset
from tests.components.robot import make_robot_log
from tests.components.synthetic import make_log, relabelled

ROBOT = make_robot_log()


def small() -> OfflineDataset:
    """Episodes of two steps (a fall), one (cut by time) and three (a fall)."""
    return relabelled(
        ROBOT,
        frames=np.arange(27, dtype=np.float32).reshape(9, 3),
        actions=np.arange(12, dtype=np.float32).reshape(6, 2),
        rewards=np.arange(1.0, 7.0, dtype=np.float32),
        terminated=np.array([0, 1, 0, 0, 0, 1], dtype=np.bool_),
        truncated=np.array([0, 0, 1, 0, 0, 0], dtype=np.bool_),
        episode_starts=np.array([0, 2, 3, 6]),
    )


def test_falls_last_and_time_outs_do_not() -> None:
    found = with_absorbing_states(small(), 3)
    assert found.episode_starts.tolist() == [0, 5, 6, 12]
    assert found.frames[:, 0].tolist() == [0, 3, 6, 6, 6, 6, 9, 12, 15, 18, 21, 24, 24, 24, 24]
    assert found.rewards.tolist() == [1, 2, 0, 0, 0, 3, 4, 5, 6, 0, 0, 0]
    # the episode's own actions once more, from the last one back and around
    assert found.actions[:, 0].tolist() == [0, 2, 2, 0, 2, 4, 6, 8, 10, 10, 8, 6]
    terminal = [0, 1, 1, 1, 1, 0, 0, 0, 1, 1, 1, 1]
    assert found.terminated.tolist() == [bool(t) for t in terminal]
    assert found.truncated.tolist() == [n == 5 for n in range(12)]
    assert found.card.digest != small().card.digest
    assert found.card.transitions == 12
    assert {array.dtype for array in found.arrays().values()} == {
        array.dtype for array in small().arrays().values()
    }


def test_nothing_is_added_where_nothing_falls() -> None:
    machine = make_log()
    assert with_absorbing_states(machine, 7) is machine
    assert with_absorbing_states(ROBOT, 0) is ROBOT


def test_logged_transitions_stay_where_they_were_within_their_episodes() -> None:
    found = with_absorbing_states(ROBOT, 4)
    assert found.transitions == ROBOT.transitions + 4 * int(ROBOT.terminated.sum())
    for episode in range(ROBOT.episodes):
        start, end = ROBOT.episode_starts[episode : episode + 2]
        rows = found.episode_starts[episode] + np.arange(end - start)
        for name in ("actions", "rewards", "terminated", "truncated"):
            ours, theirs = getattr(found, name), getattr(ROBOT, name)
            np.testing.assert_array_equal(ours[rows], theirs[start:end])
        np.testing.assert_array_equal(
            found.frames[found.frame_rows()[rows] + 1],
            ROBOT.frames[ROBOT.frame_rows()[start:end] + 1],
        )
