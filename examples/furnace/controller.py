"""The controller that has always run the furnace: a rule, and operators who interfere.

The rule stays on the safe side, hotter than the steel needs and with plenty of air, more of both
when the mill is fast. Every shift has its habits, which shift the rule a little. Now and then an
operator sets both by hand for some minutes, because of a hunch or to see what happens.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from examples.furnace.plant import BOUNDS, FEATURES

__all__ = ["Operators"]

Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Rule:
    """What is set, and how far from it hands go."""

    set_point: float = 1160.0  # degrees Celsius
    ratio: float = 13.0  # of air to gas; ten would be enough for perfect mixing
    usual: float = 15.0  # tonnes per hour, from which the rule departs ...
    hotter: float = 1.0  # ... by so many kelvin a tonne,
    more_air: float = 0.1  # and so much of the ratio
    habits: tuple[float, float] = (2.0, 0.15)  # deviation of the shifts
    ratio_by_hand: float = 1.2  # largest change of the ratio
    begins: float = 0.04  # chance of a hand in a step without one
    stays: tuple[int, int] = (8, 30)  # steps


class Operators:
    """Those who run N furnaces for a shift.

    Args:
        count: Of furnaces.
        seed: Of everything random.
        boldness: Kelvin by which they change the set point at most.
    """

    def __init__(self, count: int, seed: int, boldness: float) -> None:
        self._rng, self._rule = np.random.default_rng(seed), Rule()
        self._most = np.array([boldness, self._rule.ratio_by_hand])
        self._habit = self._rng.normal(0, self._rule.habits, (count, 2))
        self._change = np.zeros((count, 2))
        self._left = np.zeros(count, int)

    def act(self, readings: Numbers) -> tuple[Numbers, npt.NDArray[np.bool_]]:
        """Set point and ratio `[N, 2]` for readings `[N, 4]`, and where they come from a hand."""
        rule, rng, count = self._rule, self._rng, len(readings)
        faster = readings[:, FEATURES.index("throughput")] - rule.usual
        usual = np.array([rule.set_point, rule.ratio])
        by_rule = usual + self._habit + np.outer(faster, [rule.hotter, rule.more_air])
        begins = (self._left == 0) & (rng.random(count) < rule.begins)
        self._left = np.where(begins, rng.integers(*rule.stays, count), self._left - 1).clip(0)
        drawn = rng.uniform(-1, 1, (count, 2)) * self._most
        self._change = np.where(begins[:, None], drawn, self._change)
        manual = self._left > 0
        return (by_rule + self._change * manual[:, None]).clip(
            *np.array([*BOUNDS.values()]).T
        ), manual
