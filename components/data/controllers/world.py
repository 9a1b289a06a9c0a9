"""The controller that logged the 2-D world (thesis 6.5): to the nearer of its goals."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["to_nearest"]


def to_nearest(positions: NDArray[np.float64], goals: Sequence[ArrayLike]) -> NDArray[np.float64]:
    """Go to the nearest goal, at most 1 a step along each coordinate.

    Args:
        positions: `[N, 2]`.
        goals: Their positions; of equally near ones the first is taken.

    Returns:
        Actions `[N, 2]` in [-1, 1]; a goal within reach is hit exactly.
    """
    ways = np.asarray(goals, dtype=np.float64) - positions[:, None]  # [N, goals, 2]
    nearest = np.square(ways).sum(axis=-1).argmin(axis=1)
    actions: NDArray[np.float64] = np.clip(ways[np.arange(len(positions)), nearest], -1.0, 1.0)
    return actions
