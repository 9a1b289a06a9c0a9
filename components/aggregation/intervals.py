"""Intervals that know what is independent: seeds, not policies.

The pool of a (dataset, algorithm) pair holds several snapshots of every seed. Snapshots of one
training resemble each other, so a pool of ten policies from five seeds has five independent units.
The thesis's standard error, 1.7 sd / sqrt(N), counts policies; these intervals draw whole seeds.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from components.aggregation.statistics import PERCENTILE

__all__ = ["CONFIDENCE", "percentile_interval", "seed_interval"]

CONFIDENCE: Final = 0.95
_RESAMPLES: Final = 2000
_RANDOM: Final = 0  # seed of the resampling: the same numbers give the same interval


def seed_interval(
    pool: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Bootstrap interval of the 10th percentile of a pool, in which seeds are drawn whole.

    Args:
        pool: ``[seeds, last, ...]`` mean returns of the last snapshots of every seed.

    Returns:
        Lower and upper end ``[...]`` of the 95 % percentile interval; NaN where a return is not
        finite, and everywhere with a single seed, from which no spread can be told.
    """
    seeds = len(pool)
    undefined = ~np.isfinite(pool).all(axis=(0, 1))
    if seeds < 2 or undefined.all():
        nowhere = np.full(pool.shape[2:], np.nan)
        return nowhere, nowhere
    defined = np.where(undefined, 0.0, pool)

    def statistic(drawn: npt.NDArray[np.intp], axis: int) -> npt.NDArray[np.float64]:
        rows = np.moveaxis(drawn, axis, 0)  # [seeds, resamples], or [seeds]
        picked = np.moveaxis(defined[rows], rows.ndim, 1)  # [seeds, last, resamples, ...]
        merged = picked.reshape(-1, *picked.shape[2:])
        percentiles: npt.NDArray[np.float64] = np.percentile(merged, PERCENTILE, axis=0)
        return np.moveaxis(percentiles, 0, -1) if rows.ndim > 1 else percentiles

    low, high = percentile_interval(statistic, (np.arange(seeds),), _RESAMPLES)
    return np.where(undefined, np.nan, low), np.where(undefined, np.nan, high)


def percentile_interval(
    statistic: Callable[..., npt.NDArray[np.float64]],
    samples: Sequence[npt.NDArray[Any]],
    resamples: int,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Ends of the 95 % percentile interval of a statistic, by the bootstrap.

    Args:
        statistic: Of as many samples, over their last axis or ``axis``.
        samples: Each is drawn again by itself.
        resamples: How often.
    """
    from scipy.stats import bootstrap  # slow to import, and no plan needs it

    found = bootstrap(
        samples,
        statistic,
        n_resamples=resamples,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=_RANDOM,
        vectorized=True,
    ).confidence_interval
    return found.low, found.high
