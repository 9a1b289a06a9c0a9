"""Statistics of a pool of evaluated policies.

The pool of a (dataset, algorithm) pair holds the last snapshots of every seed; each member is one
policy, represented by its mean return over its real trajectories (thesis 5.1.2).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["PERCENTILE", "PoolStatistics", "pool_policies", "pooled_snapshots", "summarise"]

PERCENTILE = 10.0
STANDARD_ERROR_FACTOR = 1.7  # the thesis's factor; exact for a normal is 1.709
TRIM = 0.25  # share cut from either end for the interquartile mean


@dataclass(frozen=True)
class PoolStatistics:
    """What a pool of policies achieved.

    Attributes:
        policies: Size N of the pool.
        tenth_percentile: With linear interpolation between order statistics.
        standard_error: 1.7 sd / sqrt(N), the standard error of the tenth percentile.
        mean: Of the pool.
        std: Sample standard deviation of the pool (0 for a single policy).
        iqm: Mean of what is left when floor(N / 4) policies are cut from either end.
    """

    policies: int
    tenth_percentile: float
    standard_error: float
    mean: float
    std: float
    iqm: float

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers by name."""
        return asdict(self)


def pooled_snapshots(snapshots: int, fraction: float) -> int:
    """How many of the last snapshots of a seed are pooled: a fraction of them, at least one."""
    return max(1, round(fraction * snapshots))


def pool_policies(
    returns_per_seed: Sequence[npt.NDArray[np.float64]], last: int
) -> npt.NDArray[np.float64]:
    """Mean returns of the last snapshots of all seeds.

    Args:
        returns_per_seed: Per seed ``[S, ..., trajectories]``.
        last: Snapshots of each seed that enter the pool.

    Returns:
        ``[seeds * last, ...]``.

    Raises:
        ValueError: If a seed has fewer snapshots.
    """
    shortest = min(len(returns) for returns in returns_per_seed)
    if not 1 <= last <= shortest:
        raise ValueError(f"The pool takes the last {last} snapshots, but a seed has {shortest}.")
    return np.concatenate([returns[-last:].mean(axis=-1) for returns in returns_per_seed])


def summarise(pool: npt.NDArray[np.float64]) -> PoolStatistics:
    """Reduce a pool ``[N]`` of policy returns.

    If the return of any policy is not finite, every statistic but the count is NaN: diverged
    policies are not left out of the pool.
    """
    size = len(pool)
    if not np.isfinite(pool).all():
        nan = float("nan")
        return PoolStatistics(size, nan, nan, nan, nan, nan)
    std = float(pool.std(ddof=1)) if size > 1 else 0.0
    cut = int(TRIM * size)
    middle = np.sort(pool)[cut : size - cut]
    return PoolStatistics(
        policies=size,
        tenth_percentile=float(np.percentile(pool, PERCENTILE)),
        standard_error=STANDARD_ERROR_FACTOR * std / size**0.5,
        mean=float(pool.mean()),
        std=std,
        iqm=float(middle.mean()),
    )
