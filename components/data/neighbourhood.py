"""What is near a set of rows: the distance to the nearest of them, and how far is still usual.

Distances are in units of the rows' own deviations. A column that never changes says nothing, but
another value of it is foreign.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["Neighbourhood"]


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """Rows, and the distance up to which others belong to them.

    Attributes:
        rows: `[n, D]` that others are compared to.
        limit: Distance beyond which a row is outside.
    """

    rows: NDArray[np.floating]
    limit: float

    @classmethod
    def around(
        cls,
        rows: NDArray[np.floating],
        familiar: Sequence[NDArray[np.floating]],
        quantile: float,
    ) -> "Neighbourhood":
        """The neighbourhood that holds nearly all of what is familiar.

        Args:
            rows: `[n, D]` that others are compared to.
            familiar: Sets of rows `[m, D]`; the widest of them decides.
            quantile: Share of a set that lies within.
        """
        free = cls(rows, np.inf)
        reaches = [float(np.quantile(free.distances(own), quantile)) for own in familiar]
        return cls(rows, max(reaches))

    def distances(self, others: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distances `[...]` of rows `[..., D]` to the nearest."""
        found: NDArray[np.float64] = self._tree.query(others / self._scale)[0]
        return found

    def outside(self, others: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether rows `[..., D]` are beyond the limit, `[...]`."""
        beyond: NDArray[np.bool_] = self.distances(others) > self.limit
        return beyond

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        deviation = self.rows.std(axis=0, dtype=np.float64)
        return np.where(deviation > 0, deviation, 1.0)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.rows / self._scale)
