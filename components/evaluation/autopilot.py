"""The autopilot: a safe search for the proximity, one trajectory at a time (thesis 7.2).

A policy with a proximity is given, and a budget of trajectories on the real system. The search
starts at the clone (proximity 0) and tries only what is safe by what it has seen: from a proximity
``x`` whose mean return is at least ``l`` all proximities up to ``x + (l - floor) / slope`` are, in
the manner of SafeOpt (Sui et al. 2015) with confidence intervals in the place of a Gaussian
process's. The floor lies a margin below the behaviour's return. It ends where nothing further is
safe, at proximity 1, or with the budget, and answers with the proximity of the greatest lower
bound.

The guarantee: with probability ``1 - risk`` no trajectory is ever made at a proximity whose mean
return lies below the floor, and the answer's does not lie below the floor either. It holds if

- the mean return falls by at most ``slope`` per unit of proximity (rise it may as it likes);
- returns at one proximity are independent and normal, and no proximity is noisier than the clone
  (or than ``noise`` says, where that is given). Where trajectories at one proximity scatter more,
  their own deviation is taken, which is sensible and proves nothing.

The risk is spent as follows: a quarter on the deviation of the noise (an upper chi-square bound
from the warm-up), the rest evenly on as many proximities as the budget allows, and at each of them
on its n-th trajectory with the weight ``6 / (pi n)^2``, so that it may be looked at at any time.

The logic knows no system: whoever drives it asks ``propose()``, makes a trajectory there and tells
its return.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from statistics import NormalDist, fmean, stdev

from scipy.stats import chi2

__all__ = ["Autopilot", "AutopilotConfig", "Found", "Tried", "fly"]


@dataclass(frozen=True, kw_only=True)
class AutopilotConfig:
    """What a search is allowed, in units of return.

    Attributes:
        budget: Trajectories in all.
        margin: By how much a proximity's mean return may stay below the behaviour's.
        slope: The mean return falls by at most so much per unit of proximity.
        risk: Probability with which the guarantee may fail.
        reference: The behaviour's mean return, where it is known, e.g. from the log; None: that of
            proximity 0, which the warm-up measures.
        noise: Standard deviation of a trajectory's return, where it is known; None: the warm-up
            measures it.
        warm_up: Trajectories at proximity 0 before anything else is tried.
        step: The longest step ahead, however safe.
        resolution: The shortest step worth a trajectory.
    """

    budget: int
    margin: float
    slope: float
    risk: float = 0.1
    reference: float | None = None
    noise: float | None = None
    warm_up: int = 8
    step: float = 0.05
    resolution: float = 0.01

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        least = 2 if self.noise is None else 1
        if not least <= self.warm_up <= self.budget:
            raise ValueError(
                f"warm_up must be at least {least} and at most the budget of {self.budget} "
                f"trajectories, got {self.warm_up}."
            )
        for name in ("margin", "slope"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be a positive number, got {getattr(self, name)}.")
        if not 0 < self.risk < 1:
            raise ValueError(f"risk must lie between 0 and 1, got {self.risk}.")
        if not 0 < self.resolution <= self.step <= 1:
            raise ValueError(
                "0 < resolution <= step <= 1 is needed, got "
                f"resolution={self.resolution} and step={self.step}."
            )
        if self.reference is not None and not math.isfinite(self.reference):
            raise ValueError(f"reference must be a number, got {self.reference}.")
        if self.noise is not None and not (math.isfinite(self.noise) and self.noise >= 0):
            raise ValueError(f"noise must be a number from 0, got {self.noise}.")


@dataclass(frozen=True)
class Tried:
    """A proximity that was tried.

    Attributes:
        proximity: Where.
        returns: Of the trajectories there, in their order.
        mean: Their mean.
        width: Half of its confidence interval.
    """

    proximity: float
    returns: tuple[float, ...]
    mean: float
    width: float

    @property
    def lower(self) -> float:
        """Lower confidence bound of the mean return."""
        return self.mean - self.width


@dataclass(frozen=True)
class Found:
    """The answer of a search.

    Attributes:
        proximity: Of the greatest lower bound.
        mean: Mean return seen there.
        lower: Its lower confidence bound.
        trajectories: Used in all.
        why: Why the search ended, or that it has not.
        tried: All proximities that were tried, from 0 up.
    """

    proximity: float
    mean: float
    lower: float
    trajectories: int
    why: str
    tried: tuple[Tried, ...]


@dataclass
class Autopilot:
    """A search, driven by ``propose`` and ``tell`` in turns.

    Attributes:
        config: What it is allowed.
    """

    config: AutopilotConfig
    _returns: dict[float, list[float]] = field(default_factory=dict, init=False)
    _proposed: float | None = field(default=None, init=False)
    _why: str = field(default="", init=False)

    def propose(self) -> float | None:
        """The proximity of the next trajectory; None: the search is over.

        Asked again before a return is told, it answers the same.
        """
        if self._proposed is None and not self._why:
            self._proposed = self._next()
        return self._proposed

    def tell(self, value: float) -> None:
        """The discounted return of a trajectory at the proposed proximity.

        Raises:
            ValueError: Nothing was proposed, or the return is undefined: a trajectory that failed
                has no place in a mean, so end the search there.
        """
        if self._proposed is None:
            raise ValueError("No trajectory was proposed; ask propose() first.")
        if not math.isfinite(value):
            raise ValueError(f"The return must be a number, got {value}; end the search here.")
        self._returns.setdefault(self._proposed, []).append(float(value))
        self._proposed = None

    @property
    def used(self) -> int:
        """Trajectories told so far."""
        return sum(map(len, self._returns.values()))

    @property
    def floor(self) -> float:
        """Mean return below which nothing is tried; undefined before the first return."""
        if self.config.reference is not None:
            return self.config.reference - self.config.margin
        clone = self.tried()[0]
        # The behaviour's return may lie this much higher than what was seen of it.
        return clone.mean + clone.width - self.config.margin

    def tried(self) -> list[Tried]:
        """All proximities tried, from 0 up."""
        noise = self._noise()
        return [self._seen(place, noise) for place in sorted(self._returns)]

    def result(self) -> Found:
        """The best so far, at any time after the first return.

        Raises:
            ValueError: There is none.
        """
        if not self._returns:
            raise ValueError("Nothing was tried yet.")
        tried = tuple(self.tried())
        best = max(tried, key=lambda one: one.lower)
        why = self._why or "not over"
        return Found(best.proximity, best.mean, best.lower, self.used, why, tried)

    # -- the search -----------------------------------------------------------------------------

    def _next(self) -> float | None:
        config = self.config
        if self.used >= config.budget:
            self._end("the budget is used")
            return None
        if self.used < config.warm_up:
            return 0.0
        tried = self.tried()
        farthest = tried[-1].proximity
        if farthest >= 1.0:
            self._end("proximity 1 is reached")
            return None
        floor = self.floor
        reach = max(one.proximity + (one.lower - floor) / config.slope for one in tried)
        # Proximities are kept to a billionth: sums of steps shall end at 1, not beside it.
        ahead = min(reach, farthest + config.step, 1.0)
        if reach >= 1.0 or reach >= farthest + config.resolution:
            return round(ahead, 9)
        return self._look_again(tried)

    def _look_again(self, tried: list[Tried]) -> float | None:
        """Where narrower bounds would lead ahead: at the proximity that leads farthest, or at 0."""
        config, clone, farthest = self.config, tried[0], tried[-1].proximity
        own = config.reference is None  # the floor has a width, too
        floor = self.floor - (clone.width if own else 0.0)
        reach = {one.proximity: one.proximity + (one.mean - floor) / config.slope for one in tried}
        leader = max(tried, key=lambda one: reach[one.proximity])
        if reach[leader.proximity] < min(1.0, farthest + config.resolution):
            self._end("nothing further is safe")
            return None
        if own and clone.width > leader.width:
            return clone.proximity
        if leader.width > 0:
            return leader.proximity
        self._end("nothing further is safe")
        return None

    def _end(self, why: str) -> None:
        self._why = why

    # -- confidence -----------------------------------------------------------------------------

    def _noise(self) -> float:
        """Upper bound of a return's standard deviation; infinite before the warm-up is over."""
        config = self.config
        if config.noise is not None:
            return config.noise
        first = self._returns.get(0.0, [])[: config.warm_up]
        if len(first) < config.warm_up:
            return math.inf
        return stdev(first) * self._inflation

    @cached_property
    def _inflation(self) -> float:
        """From the deviation seen in the warm-up to its upper bound."""
        freedom = self.config.warm_up - 1
        return math.sqrt(freedom / float(chi2.ppf(self.config.risk / 4, freedom)))

    def _seen(self, proximity: float, noise: float) -> Tried:
        config, returns = self.config, self._returns[proximity]
        count = len(returns)
        # One share for each proximity, and one for the upper bound of the behaviour's return.
        share = config.risk * (0.75 if config.noise is None else 1.0) / (config.budget + 1)
        quantile = -NormalDist().inv_cdf(share * 6 / (math.pi * count) ** 2)
        mean = fmean(returns)
        own = stdev(returns, mean) if count > 1 else 0.0
        width = quantile * max(noise, own) / math.sqrt(count)
        return Tried(proximity, tuple(returns), mean, width)


def fly(pilot: Autopilot, make: Callable[[float], float]) -> Found:
    """Drive a search to its end.

    Args:
        pilot: The search.
        make: Makes a trajectory at a proximity and returns its discounted return.
    """
    while (proximity := pilot.propose()) is not None:
        pilot.tell(make(proximity))
    return pilot.result()
