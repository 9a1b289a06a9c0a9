"""Intervals that know what is independent: seeds, not policies.

The pool of a (dataset, algorithm) pair holds several snapshots of every seed. Snapshots of one
training resemble each other, so a pool of ten policies from five seeds has five independent units.
The thesis's standard error, 1.7 sd / sqrt(N), counts policies; these intervals draw whole seeds.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.stats import bootstrap

from components.aggregation.statistics import PERCENTILE

__all__ = ["CONFIDENCE", "seed_interval"]

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

    found = bootstrap(
        (np.arange(seeds),),
        statistic,
        n_resamples=_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=_RANDOM,
        vectorized=True,
    ).confidence_interval
    return np.where(undefined, np.nan, found.low), np.where(undefined, np.nan, found.high)
