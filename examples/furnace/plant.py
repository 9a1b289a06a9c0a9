"""The plant: a gas-fired furnace that reheats steel, simulated for many furnaces at once.

Every 30 seconds somebody sets two things, the temperature that is wanted and the ratio of air to
gas, and four instruments are read: temperature, oxygen in the flue gas, flow of gas and throughput
of steel. A PI controller of the furnace's own turns the valve of the gas. Money is lost in three
ways: gas costs something, steel that is too hot or too cold becomes scrap, and unburned gas is
fined.

More air than the gas needs burns all of it, but leaves hot through the chimney: the leaner the air,
the less gas is needed. Below a tenth of excess air part of the gas stays unburned. The optimum is
beside that cliff, so those who run a furnace keep away from it, at a third of excess air or more.

What cannot be read: the temperature of the walls, which store more heat than the chamber; the
heating value of the gas and the air that leaks in, which drift; the sum in the PI controller; and
all true values behind the noise of the instruments, of which that of oxygen lags behind as well.
The numbers are those of a small furnace of a rolling mill, rounded.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

__all__ = ["BOUNDS", "FEATURES", "STEP", "Furnaces"]

Numbers = npt.NDArray[np.float64]

FEATURES: Final = ("temperature", "oxygen", "gas", "throughput")
"""What is read: degrees Celsius, per cent of the flue gas, cubic metres and tonnes per hour."""
BOUNDS: Final = {"set_point": (1130.0, 1180.0), "ratio": (10.0, 15.0)}
"""What may be set: degrees Celsius, and cubic metres of air for each of gas."""
STEP: Final = 30.0
"""Seconds between two readings."""

_HOURS: Final = STEP / 3600
_NOISE: Final = (1.0, 0.1, 2.0, 0.05)  # deviation of the readings


@dataclass(frozen=True)
class Physics:
    """Constants of the furnace; powers in kW, heat capacities in kWh/K."""

    heating_value: float = 10.0  # kWh per cubic metre of gas, of which drift takes or adds some
    air_needed: float = 10.0  # cubic metres that burn one of gas
    flue_heat: float = 3.9e-4  # kWh per cubic metre of flue gas and kelvin
    recuperated: float = 0.3  # share of the flue gas's heat that comes back with the air
    mixing: float = 0.05  # deviation of the local from the overall excess of air
    steel_heat: float = 0.195  # kWh per tonne and kelvin
    chamber: float = 3.0  # heat capacity of chamber and charge
    walls: float = 12.0  # of the walls
    into_walls: float = 12.0  # kW per kelvin between the two
    outside: float = 0.35  # kW per kelvin from the walls to the hall
    hall: float = 30.0  # degrees Celsius
    oxygen_lag: float = 0.5  # share of the way that the oxygen reading goes in a step
    valve_lag: float = 0.7  # share of the way that a flow goes in a step


@dataclass(frozen=True)
class Tuning:
    """The furnace's own PI controller of the temperature: cubic metres of gas per hour."""

    base: float = 110.0
    per_tonne: float = 36.0  # for each tonne per hour
    proportional: float = 4.0  # for each kelvin too cold
    integral: float = 0.4  # for each kelvin and step
    most: float = 120.0  # that the sum may come to
    valve: tuple[float, float] = (250.0, 1000.0)


@dataclass(frozen=True)
class Prices:
    """What a step costs."""

    gas: float = 0.35  # euros per cubic metre
    unburned: float = 20.0  # euros per cubic metre, the fine
    scrap: float = 0.015  # euros for each tonne per hour, if ten kelvin are wrong; goes as squares
    wanted: float = 1150.0  # degrees Celsius


class Furnaces:
    """Furnaces side by side, each with its own weather.

    Args:
        count: How many, N.
        seed: Of everything random.
    """

    def __init__(self, count: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._physics, self._tuning, self._prices = Physics(), Tuning(), Prices()
        draw = self._rng.normal
        self._level = draw(15.0, 1.5, count).clip(11, 19)  # throughput of the shift
        self._throughput = self._level + draw(0, 0.5, count)
        self._quality = draw(1.0, 0.02, count)  # of the gas
        self._leak = draw(250.0, 60.0, count).clip(0)
        self._temperature = draw(1160.0, 8.0, count)
        self._walls = self._temperature - draw(35.0, 5.0, count)
        self._sum = np.zeros(count)
        self._gas = self._wanted_gas(self._temperature)
        self._air = 13.0 * self._gas
        self._oxygen = self._flue_oxygen()

    def read(self) -> Numbers:
        """`[N, 4]` what the instruments show, in the order of `FEATURES`."""
        true = [self._temperature, self._oxygen, self._gas, self._throughput]
        return np.stack(true, axis=1) + self._rng.normal(0, _NOISE, (len(self._gas), len(true)))

    def step(self, set_point: Numbers, ratio: Numbers) -> Numbers:
        """Set both and wait for a step.

        Args:
            set_point: `[N]`, cut to its bounds.
            ratio: `[N]`, likewise.

        Returns:
            `[N]` euros that were made: less than nothing.
        """
        physics, prices = self._physics, self._prices
        gas = self._wanted_gas(set_point.clip(*BOUNDS["set_point"]))
        air = ratio.clip(*BOUNDS["ratio"]) * gas
        self._gas += physics.valve_lag * (gas - self._gas)
        self._air += physics.valve_lag * (air - self._air)
        unburned = self._gas * self._unburned_share()
        self._heat(physics.heating_value * self._quality * (self._gas - unburned))
        self._oxygen += physics.oxygen_lag * (self._flue_oxygen() - self._oxygen)
        self._drift()
        wrong = (self._temperature - prices.wanted) / 10
        scrap = prices.scrap * self._throughput * wrong**2
        per_hour = prices.gas * self._gas + prices.unburned * unburned
        return np.asarray(-_HOURS * per_hour - scrap)

    def _wanted_gas(self, set_point: Numbers) -> Numbers:
        """Gas that the PI controller wants."""
        tuning = self._tuning
        error = set_point - self._temperature
        self._sum = (self._sum + tuning.integral * error).clip(-tuning.most, tuning.most)
        gas = tuning.base + tuning.per_tonne * self._throughput
        return np.asarray((gas + tuning.proportional * error + self._sum).clip(*tuning.valve))

    def _excess(self) -> Numbers:
        """Air there is, as a share of the air that is needed."""
        needed = self._physics.air_needed * self._quality * self._gas
        return np.asarray((self._air + self._leak) / needed)

    def _unburned_share(self) -> Numbers:
        """Mean shortage of air where its local excess is normally distributed."""
        z = (self._excess() - 1) / self._physics.mixing
        share = self._physics.mixing * (norm.pdf(z) - z * norm.sf(z))
        return np.asarray(share.clip(0, 1))

    def _flue_oxygen(self) -> Numbers:
        """Per cent of the flue gas."""
        return np.asarray(21 * (1 - 1 / np.maximum(self._excess(), 1.0)))

    def _heat(self, fire: Numbers) -> None:
        """Let the heat of the fire flow for a step."""
        physics = self._physics
        above = self._temperature - physics.hall
        flue = physics.flue_heat * (self._gas + self._air + self._leak) * above
        flue *= 1 - physics.recuperated
        steel = physics.steel_heat * self._throughput * above
        into_walls = physics.into_walls * (self._temperature - self._walls)
        outside = physics.outside * (self._walls - physics.hall)
        self._temperature += _HOURS * (fire - flue - steel - into_walls) / physics.chamber
        self._temperature += self._rng.normal(0, 0.3, above.shape)
        self._walls += _HOURS * (into_walls - outside) / physics.walls

    def _drift(self) -> None:
        """Change what nobody sets: throughput, heating value and leaks wander about their means."""
        draw, count = self._rng.normal, len(self._gas)
        self._throughput += 0.03 * (self._level - self._throughput) + draw(0, 0.1, count)
        self._quality += 0.005 * (1.0 - self._quality) + draw(0, 0.001, count)
        self._leak += 0.01 * (250.0 - self._leak) + draw(0, 8.0, count)
