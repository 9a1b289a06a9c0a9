"""Pairs of a log: frames with the actions taken there, by which what is familiar is known.

Two things ask how far a pair is from the log: the price on leaving it in training, and the judges'
warning. Both compare it with some pairs of the training episodes, evenly spaced, and call familiar
what is as near to these as the pairs of the held-out episodes are.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset
from components.data.splits import split_episodes

__all__ = ["logged_pairs", "split_pairs", "spread_rows"]

Spread = Callable[[NDArray[np.int64], int], NDArray[np.int64]]
"""At most so many of some rows."""


def spread_rows(rows: NDArray[Any], count: int) -> NDArray[Any]:
    """At most ``count`` of the rows, evenly spaced, the first and the last included."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).round().astype(np.int64)]


def logged_pairs(dataset: OfflineDataset, rows: NDArray[np.int64]) -> NDArray[np.floating]:
    """Frames with the actions taken there, as logged, ``[n, F + A]``.

    Args:
        dataset: The log.
        rows: Transitions ``[n]``.
    """
    frames = dataset.frames[dataset.frame_rows()[rows]]
    return np.concatenate([frames, dataset.actions[rows]], axis=1)


def split_pairs(
    dataset: OfflineDataset, count: int, spread: Spread = spread_rows
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Pairs to compare others with, and held-out ones, at most ``count`` of each.

    Args:
        dataset: The log, of at least two episodes.
        count: Of either side.
        spread: Chooses them.

    Returns:
        Those of the training episodes and those of the held-out ones, ``[n, F + A]`` each.

    Raises:
        ValueError: The log has a single episode.
    """
    boundary = split_episodes(dataset).trained_transitions(dataset)
    rows = np.arange(dataset.transitions)
    near, held_out = (
        logged_pairs(dataset, spread(part, count)) for part in (rows[:boundary], rows[boundary:])
    )
    return near, held_out
