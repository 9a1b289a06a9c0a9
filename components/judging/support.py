"""The support of a log: whether a frame with an action resembles one that was logged.

The distance of a pair to the log is that to its nearest logged neighbour, in units of the log's own
deviations. What is farther away than nearly all of what is familiar is outside. Familiar are the
log's own held-out transitions, and what the behaviour policy visits: the log of a controller that
never explores fills so thin a set that even its clone hardly meets it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from components.data.dataset import OfflineDataset
from components.data.splits import split_episodes
from components.judging.rollouts import spread_rows

__all__ = ["Support"]


class Support:
    """The support of a log.

    Args:
        dataset: The log, of at least two episodes.
        familiar: Frames with actions of the behaviour policy, ``[n, F + A]``.
        neighbours: Logged transitions that others are compared to, at most.
        quantile: Share of the familiar that lies within.
    """

    def __init__(
        self,
        dataset: OfflineDataset,
        familiar: NDArray[np.floating],
        neighbours: int,
        quantile: float,
    ) -> None:
        boundary = split_episodes(dataset).trained_transitions(dataset)
        rows = np.arange(dataset.transitions)
        near = _pairs(dataset, spread_rows(rows[:boundary], neighbours))
        held_out = _pairs(dataset, spread_rows(rows[boundary:], neighbours))
        deviation = near.std(axis=0)
        # A feature that never changes says nothing, but another value of it is foreign.
        self._scale = np.where(deviation > 0, deviation, 1.0)
        self._tree = KDTree(near / self._scale)
        self._limit = max(
            float(np.quantile(self._distances(own), quantile)) for own in (held_out, familiar)
        )

    def outside(self, pairs: NDArray[np.float32]) -> NDArray[np.float64]:
        """Share of frames with actions ``[..., V, F + A]`` that lie outside, ``[...]``."""
        share: NDArray[np.float64] = (self._distances(pairs) > self._limit).mean(axis=-1)
        return share

    def _distances(self, pairs: NDArray[np.floating]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self._tree.query(pairs / self._scale)[0]
        return found


def _pairs(dataset: OfflineDataset, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Frames with the actions taken there, ``[n, F + A]``."""
    frames = dataset.frames[dataset.frame_rows()[rows]]
    return np.concatenate([frames, dataset.actions[rows]], axis=1).astype(np.float64)
