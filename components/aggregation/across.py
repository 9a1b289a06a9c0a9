"""Comparing algorithms over datasets: scores of runs, their middle, profiles, and who wins.

After Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (2021):
every (dataset, seed) is a run with a score; intervals come from a bootstrap that draws seeds within
every dataset (stratified), so they speak about these datasets and about other seeds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import friedmanchisquare, rankdata, studentized_range

from components.aggregation.intervals import CONFIDENCE, percentile_interval

__all__ = [
    "Estimate",
    "Ranks",
    "improvement",
    "interquartile_mean",
    "mean_ranks",
    "profile",
    "score",
]

Array = npt.NDArray[np.float64]
Runs = Sequence[Array]
"""Scores of an algorithm: per dataset ``[R]``, one per seed."""

_RESAMPLES: Final = 1000
_TRIM: Final = 0.25  # share of the runs cut from either end


@dataclass(frozen=True)
class Estimate:
    """A number, or an array of them, with its 95 % interval."""

    value: Any
    low: Any
    high: Any


def score(returns: Array, floor: float, best: float) -> Array:
    """Returns as a share of the way from a floor (0) to the best known return (1).

    What is not finite has the floor's score, 0: the policy diverged.
    """
    scaled: Array = (np.nan_to_num(returns, nan=floor, neginf=floor) - floor) / (best - floor)
    return scaled


def interquartile_mean(runs: Runs) -> Estimate:
    """Mean of the middle half of all runs of an algorithm."""

    def statistic(*drawn: Array, axis: int = -1) -> Array:
        merged = np.sort(np.concatenate(drawn, axis=axis), axis=axis)
        cut = int(_TRIM * merged.shape[axis])
        middle: Array = merged[..., cut : merged.shape[axis] - cut].mean(axis=axis)
        return middle

    return _estimate(statistic, runs)


def profile(runs: Runs, thresholds: Array) -> Estimate:
    """Share of an algorithm's runs whose score is above each threshold ``[K]``."""

    def statistic(*drawn: Array, axis: int = -1) -> Array:
        merged = np.concatenate(drawn, axis=axis)
        shares: Array = np.stack([(merged > t).mean(axis=axis) for t in thresholds])
        return shares

    return _estimate(statistic, runs)


def improvement(one: Runs, other: Runs) -> Estimate:
    """Probability that a run of one algorithm beats one of the other on the same dataset.

    Ties count half; datasets count the same.
    """

    def statistic(*drawn: Array, axis: int = -1) -> Array:
        wins = []
        for mine, theirs in zip(drawn[: len(one)], drawn[len(one) :], strict=True):
            apart = mine[..., :, None] - theirs[..., None, :]
            wins.append(((apart > 0) + 0.5 * (apart == 0)).mean(axis=(-2, -1)))
        share: Array = np.mean(wins, axis=0)
        return share

    return _estimate(statistic, [*one, *other])


def _estimate(statistic: Callable[..., Array], samples: Runs) -> Estimate:
    value = statistic(*samples)
    if min(map(len, samples)) < 2:  # a single seed tells no spread
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    return Estimate(value, *percentile_interval(statistic, samples, _RESAMPLES))


@dataclass(frozen=True)
class Ranks:
    """Ranks of algorithms over datasets (Demšar 2006).

    Attributes:
        mean: ``[A]`` mean rank over the datasets; 1 is the best.
        critical_difference: Nemenyi: mean ranks closer than this are not told apart at 5 %.
        p_value: Friedman's: how likely such ranks are if all algorithms are equal; NaN where
            there are too few datasets or algorithms to say.
    """

    mean: Array
    critical_difference: float
    p_value: float


def mean_ranks(values: Array) -> Ranks:
    """Rank algorithms.

    Args:
        values: ``[D, A]`` of datasets and algorithms; more is better, NaN is the worst.
    """
    datasets, algorithms = values.shape
    ranks = rankdata(-np.nan_to_num(values, nan=-np.inf), axis=1)
    enough = datasets > 1 and algorithms > 2
    p_value = float(friedmanchisquare(*ranks.T).pvalue) if enough else float("nan")
    quantile = studentized_range.ppf(CONFIDENCE, algorithms, np.inf) / np.sqrt(2.0)
    critical = quantile * np.sqrt(algorithms * (algorithms + 1) / (6.0 * datasets))
    return Ranks(ranks.mean(axis=0), float(critical) if algorithms > 1 else 0.0, p_value)
