"""Discounted returns of windows of a reward sequence.

The benchmark's return is the sum over a window of H steps of discount^t times the reward, the
first reward with weight 1 (thesis section 5.1.2).
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["window_returns"]


def window_returns(
    rewards: NDArray[np.floating], discount: float, steps: int
) -> NDArray[np.float64]:
    """Discounted return of every window of one episode.

    Args:
        rewards: `[T]` or `[..., T]` rewards in time order.
        discount: factor per step.
        steps: window length H, at most T.

    Returns:
        `[..., T - H + 1]`; entry t is the return of the window that starts at step t.

    Raises:
        ValueError: fewer rewards than steps.
    """
    if not 1 <= steps <= rewards.shape[-1]:
        raise ValueError(
            f"windows of {steps} steps need as many rewards; the sequence has {rewards.shape[-1]}."
        )
    weights = discount ** np.arange(steps, dtype=np.float64)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.asarray(rewards, dtype=np.float64), steps, axis=-1
    )
    result: NDArray[np.float64] = windows @ weights
    return result
