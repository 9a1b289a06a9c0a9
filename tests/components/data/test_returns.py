"""Window returns by hand."""

import numpy as np
import pytest

from components.data.returns import window_returns


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
