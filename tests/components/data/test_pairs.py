"""Pairs of a log: which are chosen, and what they hold."""

import numpy as np
import pytest

from components.data.pairs import logged_pairs, split_pairs, spread_rows
from tests.components.synthetic import make_log

LOG = make_log()


def test_rows_are_spread_evenly() -> None:
    assert spread_rows(np.arange(3), 5).tolist() == [0, 1, 2]
    assert spread_rows(np.arange(101), 3).tolist() == [0, 50, 100]


def test_a_pair_is_the_frame_and_the_action_taken_there() -> None:
    # Every episode of 40 transitions has 41 frames.
    found = logged_pairs(LOG, np.array([0, 39, 40]))
    np.testing.assert_array_equal(found[:, :6], LOG.frames[[0, 39, 41]])
    np.testing.assert_array_equal(found[:, 6:], LOG.actions[[0, 39, 40]])


def test_the_last_episodes_are_held_out() -> None:
    near, held_out = split_pairs(LOG, 10)
    np.testing.assert_array_equal(near, logged_pairs(LOG, spread_rows(np.arange(200), 10)))
    np.testing.assert_array_equal(held_out, logged_pairs(LOG, spread_rows(np.arange(200, 240), 10)))
    whole, rest = split_pairs(LOG, 1000)
    assert (len(whole), len(rest)) == (200, 40)
    last, _ = split_pairs(LOG, 1000, lambda rows, count: rows[-1:])
    np.testing.assert_array_equal(last, logged_pairs(LOG, np.array([199])))


def test_a_single_episode_cannot_be_split() -> None:
    with pytest.raises(ValueError, match="single episode"):
        split_pairs(make_log(episodes=1), 10)
