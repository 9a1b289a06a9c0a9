"""The autopilot and the strategy of the thesis on what policies have been measured to return.

Measured are returns of several trajectories at each proximity of a grid. That makes a system whose
truth is known: its mean return at a grid point is the mean of what was measured there, in between
it is interpolated, and a trajectory scatters around it as one of those measured nearest does.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from components.evaluation.autopilot import Autopilot, AutopilotConfig, fly
from components.evaluation.curves import first_drop
from components.evaluation.guarantee import USUAL

__all__ = ["STRATEGIES", "Flight", "Flights", "MeasuredSystem", "compare"]

Array = npt.NDArray[np.float64]

STRATEGIES: Final = ("autopilot", "first drop", "first drop of 10")
"""The search of :mod:`.autopilot`, and that of thesis 6.6.1 with one trajectory at each point of
the grid, and with ten, which is how the thesis evaluates."""


@dataclass(frozen=True)
class MeasuredSystem:
    """A policy's returns.

    Attributes:
        proximities: ``[P]`` from 0 to 1.
        returns: ``[P, N]`` of N trajectories each.
    """

    proximities: Array
    returns: Array

    @property
    def means(self) -> Array:
        """``[P]``."""
        curve: Array = self.returns.mean(axis=1)
        return curve

    def mean(self, proximity: float) -> float:
        """True mean return at any proximity."""
        return float(np.interp(proximity, self.proximities, self.means))

    def trajectory(self, proximity: float, rng: np.random.Generator) -> float:
        """Return of a trajectory there."""
        nearest = int(np.abs(self.proximities - proximity).argmin())
        scatter = self.returns[nearest] - self.returns[nearest].mean()
        return self.mean(proximity) + float(rng.choice(scatter))


@dataclass(frozen=True)
class Flight:
    """One search on one system.

    Attributes:
        proximity: Its answer.
        gain: True mean return there, less the clone's.
        worst: Least true mean return on the way, less the clone's.
        trajectories: Used.
    """

    proximity: float
    gain: float
    worst: float
    trajectories: int


@dataclass(frozen=True)
class Flights:
    """Searches on one system; means over them.

    Attributes:
        clone: True mean return at proximity 0.
        best: Greatest of the grid.
        flights: By strategy.
    """

    clone: float
    best: float
    flights: Mapping[str, tuple[Flight, ...]]

    def share_below(self, strategy: str) -> float:
        """Of the flights that went below the clone's return by more than the margin."""
        found = self.flights[strategy]
        return float(np.mean([flight.worst < -USUAL.margin * abs(self.clone) for flight in found]))


def compare(
    system: MeasuredSystem,
    rng: np.random.Generator,
    *,
    budget: int = 50,
    slope: float = USUAL.slope,
    repeats: int = 5,
    strategies: Sequence[str] = STRATEGIES,
) -> Flights:
    """Let the autopilot and the stop at the first drop search, several times each.

    Args:
        system: Where.
        rng: Of the trajectories.
        budget: The autopilot's trajectories.
        slope: That the autopilot assumes, in returns of the clone per unit of proximity.
        repeats: Searches of each kind.
        strategies: Which of `STRATEGIES`.
    """
    clone = system.mean(0.0)
    size = abs(clone)
    config = AutopilotConfig(budget=budget, margin=USUAL.margin * size, slope=slope * size)
    make: Mapping[str, Callable[[], Flight]] = {
        "autopilot": lambda: _autopilot(system, config, rng),
        "first drop": lambda: _first_drop(system, 1, rng),
        "first drop of 10": lambda: _first_drop(system, 10, rng),
    }
    flights = {name: tuple(make[name]() for _ in range(repeats)) for name in strategies}
    return Flights(clone, float(system.means.max()), flights)


def _autopilot(system: MeasuredSystem, config: AutopilotConfig, rng: np.random.Generator) -> Flight:
    found = fly(Autopilot(config), lambda proximity: system.trajectory(proximity, rng))
    tried = [system.mean(one.proximity) for one in found.tried]
    return _flight(system, found.proximity, tried, found.trajectories)


def _first_drop(system: MeasuredSystem, each: int, rng: np.random.Generator) -> Flight:
    seen = [
        np.mean([system.trajectory(place, rng) for _ in range(each)])
        for place in system.proximities
    ]
    place, tried = first_drop(np.array(seen))
    means = system.means[:tried].tolist()
    return _flight(system, float(system.proximities[place]), means, each * tried)


def _flight(
    system: MeasuredSystem, proximity: float, tried: list[float], trajectories: int
) -> Flight:
    clone = system.mean(0.0)
    return Flight(proximity, system.mean(proximity) - clone, min(tried) - clone, trajectories)
