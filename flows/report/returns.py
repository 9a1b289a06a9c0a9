"""The stored returns behind a cell: policies of the pool, learning curves, intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from components.aggregation.intervals import seed_interval
from components.aggregation.statistics import pooled_snapshots
from components.core.arrays import load_arrays
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["SeedReturns", "cell_returns", "with_intervals"]

_FILE = "returns.npz"


@dataclass(frozen=True)
class SeedReturns:
    """What the snapshots of one seed achieved.

    Attributes:
        seed: Its number.
        steps: ``[S]`` updates after which the snapshots were taken.
        proximities: ``[P]`` the grid, or a single NaN.
        returns: ``[S, P]`` mean over the real trajectories.
    """

    seed: int
    steps: npt.NDArray[np.int64]
    proximities: npt.NDArray[np.float64]
    returns: npt.NDArray[np.float64]


def cell_returns(cell: Node, store: ArtifactStore) -> list[SeedReturns]:
    """What the seeds of an aggregation have found; none if any of them has been removed.

    Raises:
        DamagedFileError: A file is missing or damaged.
    """
    evaluations = list(cell.inputs.values())
    if not all(store.complete(node.key) for node in evaluations):
        return []
    return [_read(node, store) for node in evaluations]


def _read(evaluation: Node, store: ArtifactStore) -> SeedReturns:
    store.check(evaluation.key, (_FILE,))
    stored = load_arrays(store.path(evaluation.key) / _FILE)
    means = stored["returns"].mean(axis=-1)
    return SeedReturns(int(evaluation.tags["seed"]), stored["steps"], stored["lambdas"], means)


def with_intervals(
    summary: Mapping[str, Any], seeds: Sequence[SeedReturns], fraction: float
) -> dict[str, Any]:
    """A summary whose points have the seed-clustered interval of their 10th percentile.

    Args:
        summary: As aggregation stores it.
        seeds: Behind it; where there are none, points have no interval.
        fraction: Last share of the snapshots that is pooled.
    """
    if not seeds:
        return dict(summary)
    last = pooled_snapshots(len(seeds[0].returns), fraction)
    low, high = seed_interval(np.stack([seed.returns[-last:] for seed in seeds]))
    points = [
        {**point, "interval_low": float(a), "interval_high": float(b)}
        for point, a, b in zip(summary["points"], low, high, strict=True)
    ]
    return {**summary, "points": points}
