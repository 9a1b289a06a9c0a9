"""The stored returns behind a cell: policies of the pool, learning curves, intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from components.aggregation.intervals import seed_interval
from components.core.arrays import load_arrays
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore

__all__ = ["SeedReturns", "pool_of", "read_returns", "with_intervals"]

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


def read_returns(evaluation: Node, store: ArtifactStore) -> SeedReturns | None:
    """Read what an evaluation has found; None if it is not finished, or has been removed.

    Raises:
        DamagedFileError: Its file is missing or damaged.
    """
    if not store.complete(evaluation.key):
        return None
    store.check(evaluation.key, (_FILE,))
    stored = load_arrays(store.path(evaluation.key) / _FILE)
    means = stored["returns"].mean(axis=-1)
    seed = int(evaluation.tags["seed"])
    return SeedReturns(seed, stored["steps"], stored["lambdas"], means)


def pool_of(seeds: Sequence[SeedReturns], fraction: float) -> npt.NDArray[np.float64]:
    """The pool of policies ``[seeds, last, P]``: the last share of every seed's snapshots."""
    last = max(1, round(fraction * len(seeds[0].returns)))
    return np.stack([seed.returns[-last:] for seed in seeds])


def with_intervals(summary: Mapping[str, Any], cell: Node, store: ArtifactStore) -> dict[str, Any]:
    """A summary whose points have the seed-clustered interval of their 10th percentile.

    Args:
        summary: As aggregation stores it.
        cell: The aggregation.
        store: With its inputs. Where one is gone, points have no interval.

    Raises:
        DamagedFileError: The returns of an input are missing or damaged.
    """
    seeds = [read_returns(node, store) for node in cell.inputs.values()]
    known = [seed for seed in seeds if seed is not None]
    if len(known) < len(seeds):
        return dict(summary)
    low, high = seed_interval(pool_of(known, cell.config["pool_fraction"]))
    points = [
        {**point, "interval_low": float(a), "interval_high": float(b)}
        for point, a, b in zip(summary["points"], low, high, strict=True)
    ]
    return {**summary, "points": points}
