"""Which logs promise most: the dataset indicators of thesis chapter 4, from any log.

- ERI, expected return improvement (equations 4.1 and 4.2): how far the best episode is above the
  mean one. It is what copying the good episodes alone could gain.
- EAS, expected action stochasticity (4.3 to 4.6): how random the logged actions are. Its network
  is fitted by :mod:`components.models.action_stochasticity`; here it is a number.
- COI, combined offline indicator (4.4): the rank of twice the rank of ERI plus that of EAS.
- TRI, true return improvement (4.7), what they are to predict.

Chosen where the thesis leaves it open or reads in two ways:

- R^data holds the return of the first window of every episode, by the card's discount and window,
  which are those of policies in the table. Only this makes -327 the least return of the sixteen
  sets, as the thesis says; returns of whole episodes do not.
- Returns are counted from a floor, since (4.2) needs positive ones. The Industrial Benchmark has
  the thesis's -350. Elsewhere it is what an expert gives, or else the log's own least return.
- Ranks are counted from 0, the least. Equal values share the lower rank. Equal sums of ranks in COI
  are ordered by EAS: with the published ranks of ERI and EAS this gives all of the published COI.
- The constant below the fraction in (4.2) only keeps it defined: where all returns equal the
  floor, ERI is 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from components.data.dataset import OfflineDataset
from components.data.returns import log_returns

__all__ = [
    "RETURN_FLOORS",
    "LogFacts",
    "combined_ranks",
    "combined_scores",
    "expected_return_improvement",
    "log_facts",
    "ranks",
    "return_floor",
    "spearman",
    "true_return_improvement",
]

RETURN_FLOORS: Final = MappingProxyType({"proximity/IndustrialBenchmark-v0": -350.0})
"""By Gymnasium id, a return that no policy falls below under the benchmark's protocol."""
_EPSILON: Final = 1e-8
_SPREAD: Final = (5.0, 95.0)  # percentiles between which an action's range is measured


@dataclass(frozen=True)
class LogFacts:
    """What a log shows without any network.

    Attributes:
        name: Of the dataset.
        environment: Gymnasium id of its system, or what its card says instead.
        controller: What has logged it.
        epsilon: Share of its actions that were drawn at random, as far as its card knows.
        actions: Names of the values of an action.
        episodes: Number of episodes.
        windows: Episodes with a whole window of returns.
        window: Steps of a window.
        transitions: Number of transitions.
        return_mean: Mean return of the first windows.
        return_min: Least of them.
        return_max: Greatest of them.
        action_range: Per value of an action, the share of [-1, 1] between the 5th and the 95th
            percentile of what was logged, 0 to 1.
    """

    name: str
    environment: str
    controller: str
    epsilon: float
    actions: tuple[str, ...]
    episodes: int
    windows: int
    window: int
    transitions: int
    return_mean: float
    return_min: float
    return_max: float
    action_range: tuple[float, ...]

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> "LogFacts":
        """From the fields as JSON has them."""
        tuples = {k: tuple(v) for k, v in record.items() if isinstance(v, list)}
        return cls(**(record | tuples))


def log_facts(dataset: OfflineDataset) -> LogFacts:
    """What a log shows without any network.

    Raises:
        ValueError: No episode has a whole window of returns.
    """
    card = dataset.card
    first = log_returns(
        dataset.rewards,
        dataset.terminated,
        dataset.episode_starts,
        card.discount,
        card.return_steps,
    ).first
    low, high = np.percentile(np.asarray(dataset.actions, dtype=np.float64), _SPREAD, axis=0)
    return LogFacts(
        name=card.name,
        environment=card.environment,
        controller=card.controller,
        epsilon=card.epsilon,
        actions=tuple(card.action_features),
        episodes=dataset.episodes,
        windows=len(first),
        window=card.return_steps,
        transitions=dataset.transitions,
        return_mean=float(first.mean()),
        return_min=float(first.min()),
        return_max=float(first.max()),
        action_range=tuple(0.5 * float(span) for span in high - low),
    )


def return_floor(facts: LogFacts, given: float | None = None) -> float:
    """The return from which a log's returns are counted.

    Args:
        facts: Of the log.
        given: What an expert says; None: that of the system where it is known, else the log's own
            least return. One that the log falls below, as by another discount, is not the system's.

    Raises:
        ValueError: The given floor is no lower bound.
    """
    if given is None:
        known = RETURN_FLOORS.get(facts.environment, np.inf)
        return known if known <= facts.return_min else facts.return_min
    if given > facts.return_min:
        raise ValueError(
            f"{facts.name} has returns down to {facts.return_min:.6g}, below the floor of "
            f"{given:g}; give a floor that none falls below."
        )
    return given


def expected_return_improvement(facts: LogFacts, floor: float) -> float:
    """ERI (4.2): how far the best return is above the mean, relative to the mean above the floor.

    A log of a single window, or of equal returns, has 0.
    """
    if facts.return_max == facts.return_min:  # their mean may differ from them by rounding
        return 0.0
    return (facts.return_max - facts.return_mean) / (facts.return_mean - floor + _EPSILON)


def true_return_improvement(achieved: float, facts: LogFacts, floor: float) -> float:
    """TRI (4.7): how far a learned policy's return is above the log's mean, relative as in ERI."""
    return (achieved - facts.return_mean) / (facts.return_mean - floor + _EPSILON)


def ranks(values: ArrayLike) -> NDArray[np.int64]:
    """Ranks from 0, the least, ``[N]``; equal values share the lower one."""
    array = np.asarray(values, dtype=np.float64)
    found: NDArray[np.int64] = np.searchsorted(np.sort(array), array).astype(np.int64)
    return found


def combined_scores(eri: Sequence[float], eas: Sequence[float]) -> NDArray[np.int64]:
    """Twice the rank of ERI plus that of EAS, ``[N]``."""
    return 2 * ranks(eri) + ranks(eas)


def combined_ranks(eri: Sequence[float], eas: Sequence[float]) -> NDArray[np.int64]:
    """COI ``[N]``: ranks of the combined scores, equal ones ordered by EAS."""
    # Ranks of EAS are whole numbers below N, so they only decide among equal scores.
    return ranks(combined_scores(eri, eas) * len(eas) + ranks(eas))


def spearman(one: ArrayLike, other: ArrayLike) -> float:
    """Spearman's rank correlation; equal values have the mean of their ranks.

    Returns:
        NaN where it is not defined: fewer than three pairs, or all values of one side equal.
    """
    first, second = (_mean_ranks(np.asarray(side, dtype=np.float64)) for side in (one, other))
    if len(first) < 3 or not first.any() or not second.any():
        return float("nan")
    return float(first @ second / np.sqrt((first @ first) * (second @ second)))


def _mean_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranks about their mean, equal values in the middle of the places that they take."""
    ordered = np.sort(values)
    first, beyond = (ordered.searchsorted(values, side) for side in ("left", "right"))
    found: NDArray[np.float64] = 0.5 * (first + beyond - len(values)).astype(np.float64)
    return found
