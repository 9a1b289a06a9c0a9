"""Window returns by hand."""

import numpy as np
import pytest

from components.data.returns import log_returns, window_returns


def test_first_reward_has_weight_one() -> None:
    returns = window_returns(np.array([1.0, 10.0, 100.0, 1000.0]), 0.5, 2)
    assert returns.tolist() == [6.0, 60.0, 600.0]


def test_leading_axes_are_kept() -> None:
    rewards = np.arange(12, dtype=np.float32).reshape(2, 6)
    returns = window_returns(rewards, 0.9, 6)
    assert returns.shape == (2, 1)
    assert returns[1, 0] == pytest.approx(sum(0.9**t * (6 + t) for t in range(6)))


@pytest.mark.parametrize("steps", [0, 4])
def test_windows_must_fit(steps: int) -> None:
    with pytest.raises(ValueError, match="the sequence has 3"):
        window_returns(np.zeros(3), 0.9, steps)


def test_a_fall_is_absorbing_and_a_time_out_ends_what_is_known() -> None:
    rewards = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0], dtype=np.float32)
    #                   fall      time-out        fall  cut
    terminated = np.array([False, True, False, False, False, True, False])
    starts = np.array([0, 2, 5, 6, 7])
    returns = log_returns(rewards, terminated, starts, 0.5, 2)
    # 1 + 2/2, 2 + 0, 4 + 8/2, 8 + 16/2, 32 + 0; the last episode has no whole window
    assert returns.every.tolist() == [2.0, 2.0, 8.0, 16.0, 32.0]
    assert returns.first.tolist() == [2.0, 8.0, 32.0]
    longer = log_returns(rewards, terminated, starts, 0.5, 4)
    assert longer.every.tolist() == [2.0, 2.0, 32.0]
    assert longer.first.tolist() == [2.0, 32.0]


def test_a_log_without_a_whole_window_is_refused() -> None:
    with pytest.raises(ValueError, match="no episode has a window of 3 steps"):
        log_returns(np.ones(2), np.zeros(2, dtype=np.bool_), np.array([0, 2]), 0.9, 3)
