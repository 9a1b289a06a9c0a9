"""Discounted returns of windows of a reward sequence.

The benchmark's return is the sum over a window of H steps of discount^t times the reward, the
first reward with weight 1 (thesis section 5.1.2).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["RETURN_STEPS", "LogReturns", "log_returns", "window_returns"]

RETURN_STEPS: Final = 100
"""Horizon of the benchmark's returns."""


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


@dataclass(frozen=True)
class LogReturns:
    """Window returns of a log.

    Attributes:
        first: `[<= E]` of the window at the start of each episode.
        every: `[<= N]` of all windows, episode by episode.
    """

    first: NDArray[np.float64]
    every: NDArray[np.float64]


def log_returns(
    rewards: NDArray[np.floating],
    terminated: NDArray[np.bool_],
    episode_starts: NDArray[np.int64],
    discount: float,
    steps: int,
) -> LogReturns:
    """Discounted returns of the windows of a log, as evaluation counts them.

    A terminal state is absorbing: windows reach beyond it, and all rewards there are 0. What
    follows a time-out is unknown: windows that reach beyond one do not count, and an episode
    shorter than a window has none.

    Args:
        rewards: `[N]` in time order, episode by episode.
        terminated: `[N]` whether the state after the action is terminal.
        episode_starts: `[E + 1]` first transition of each episode, and N.
        discount: factor per step.
        steps: window length.

    Raises:
        ValueError: no episode has a whole window.
    """
    bounds = pairwise(episode_starts)
    windows = list(_windows(rewards, terminated, bounds, discount, steps))
    if not windows:
        raise ValueError(
            f"no episode has a window of {steps} steps; make the log or its episodes longer."
        )
    return LogReturns(np.array([w[0] for w in windows]), np.concatenate(windows))


def _windows(
    rewards: NDArray[np.floating],
    terminated: NDArray[np.bool_],
    bounds: Iterator[tuple[np.int64, np.int64]],
    discount: float,
    steps: int,
) -> Iterator[NDArray[np.float64]]:
    for begin, end in bounds:
        absorbed = steps - 1 if terminated[end - 1] else 0
        if end - begin + absorbed >= steps:
            padded = np.pad(np.asarray(rewards[begin:end], dtype=np.float64), (0, absorbed))
            yield window_returns(padded, discount, steps)
