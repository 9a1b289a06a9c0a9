"""The support of a log: whether a frame with an action resembles one that was logged.

The distance of a pair to the log is that to its nearest logged neighbour, in units of the log's own
deviations. What is farther away than nearly all of what is familiar is outside. Familiar are the
log's own held-out transitions, and what the behaviour policy visits: the log of a controller that
never explores fills so thin a set that even its clone hardly meets it.
"""

import numpy as np
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset
from components.data.neighbourhood import Neighbourhood
from components.data.pairs import split_pairs

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
        near, held_out = (part.astype(np.float64) for part in split_pairs(dataset, neighbours))
        self._near = Neighbourhood.around(near, (held_out, familiar), quantile)

    def outside(self, pairs: NDArray[np.float32]) -> NDArray[np.float64]:
        """Share of frames with actions ``[..., V, F + A]`` that lie outside, ``[...]``."""
        share: NDArray[np.float64] = self._near.outside(pairs).mean(axis=-1)
        return share
