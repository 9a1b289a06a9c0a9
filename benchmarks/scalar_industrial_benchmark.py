"""The Industrial Benchmark as a plain scalar Python loop, to compare the vectorised one with.

One machine, one step at a time, written the way the equations read, with one draw per random
number. `ScalarIndustrialBenchmark` calls NumPy's functions on single numbers, which is how such
environments, the reference included, are commonly written. `TunedScalarIndustrialBenchmark` is the
same with the functions of `math` and `min`/`max`: as fast as a scalar loop gets without tricks.

They share only the Goldstone equations, which are scalar functions anyway, with the vectorised
environment; the tests hold the two against each other.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import numpy as np

from components.environments.industrial.goldstone import SAFE_ZONE, latent_step, potential

__all__ = ["GeneratorDraws", "ScalarIndustrialBenchmark", "TunedScalarIndustrialBenchmark"]

_SHIFT_STEP = 20.0 * math.sin(math.radians(15.0)) / 0.9
_COST_WEIGHTS = (0.11111, 0.22222, 0.33333, 0.22222, 0.11111)


class Draws(Protocol):
    """One number per call."""

    def exponential(self) -> float: ...
    def uniform(self) -> float: ...
    def binary(self, chance: float) -> int: ...
    def normal(self) -> float: ...


class GeneratorDraws:
    """Draws from a NumPy generator, one at a time."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def exponential(self) -> float:
        return self._rng.exponential(0.1)

    def uniform(self) -> float:
        return self._rng.random()

    def binary(self, chance: float) -> int:
        return int(self._rng.binomial(1, chance))

    def normal(self) -> float:
        return self._rng.standard_normal()


class ScalarIndustrialBenchmark:
    """One machine; see the vectorised environment for the equations' source."""

    exp: ClassVar[Callable[[float], float]] = staticmethod(np.exp)
    clip: ClassVar[Callable[[float, float, float], float]] = staticmethod(np.clip)

    def __init__(self, draws: Draws, setpoint: float = 70.0) -> None:
        self._draws = draws
        self.setpoint = setpoint

    def reset(self) -> np.ndarray[Any, Any]:
        """Start state, then one step of action zero; returns the frame `[6]`."""
        self.velocity = self.gain = self.shift = 50.0
        self.hidden_gain = self.hidden_velocity = 0.0
        self.latents = (1, 1, 0)
        self.costs = deque([self._operational_cost()] * 10, maxlen=10)
        return self.step(np.zeros(3))[0]

    def _operational_cost(self) -> float:
        p, v, g = self.setpoint, self.velocity, self.gain
        return self.exp((2.0 * p + 4.0 * v + 2.5 * g) / 100.0)

    def _transformed_gain(self, gain: float) -> float:
        return 1.0 / (gain + self.setpoint + 1.0)

    def _transformed_velocity(self, velocity: float, gain: float) -> float:
        return (gain + self.setpoint + 2.0) / (velocity - self.setpoint + 101.0)

    def _effective_gain(self) -> float:
        low, high = self._transformed_gain(100.0), self._transformed_gain(0.0)
        return (self._transformed_gain(self.gain) - low) / (high - low)

    def _effective_velocity(self) -> float:
        low = self._transformed_velocity(0.0, 100.0)
        high = self._transformed_velocity(100.0, 0.0)
        now = self._transformed_velocity(self.velocity, self.gain)
        return 1.0 - (now - low) / (high - low)

    def _hidden(self, before: float, effective: float, noise: float) -> float:
        if effective <= 0.05:
            return effective
        if before >= 1.2:
            return min(5.0, 1.1 * before)
        return 0.9 * before + noise / 3.0

    def _fatigue(self) -> float:
        gain, velocity = self._effective_gain(), self._effective_velocity()
        base_gain = 2.0 * (1.0 / (1.0 + self.exp(-self._draws.exponential())) - 0.5)
        base_velocity = 2.0 * (1.0 / (1.0 + self.exp(-self._draws.exponential())) - 0.5)
        uniform_gain, uniform_velocity = self._draws.uniform(), self._draws.uniform()
        binary_gain = self._draws.binary(self.clip(gain, 0.001, 0.999))
        binary_velocity = self._draws.binary(self.clip(velocity, 0.001, 0.999))
        noise_gain = base_gain + (1.0 - base_gain) * uniform_gain * binary_gain * gain
        noise_velocity = (
            base_velocity + (1.0 - base_velocity) * uniform_velocity * binary_velocity * velocity
        )
        self.hidden_gain = self._hidden(self.hidden_gain, gain, noise_gain)
        self.hidden_velocity = self._hidden(self.hidden_velocity, velocity, noise_velocity)
        if max(self.hidden_gain, self.hidden_velocity) == 5.0:
            amplification = 1.0 / (1.0 + self.exp(-(2.4 + 0.4 * self._draws.normal())))
        else:
            amplification = max(noise_gain, noise_velocity)
        basic = max(0.0, 30000.0 / (5.0 * self.velocity + 100.0) - 0.01 * self.gain**2)
        return basic * (1.0 + 2.0 * amplification) / 3.0

    def _mis_calibration(self) -> float:
        shift = self.clip(self.shift / 20.0 - self.setpoint / 50.0 - 1.5, -1.5, 1.5)
        sign = 0 if abs(shift) <= SAFE_ZONE else (1 if shift > 0.0 else -1)
        self.latents = latent_step(*self.latents, sign)
        return 1.0 + potential(self.latents[2], shift)

    def step(self, action: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], float]:
        """One step; the new frame `[6]` and its reward."""
        change = [self.clip(float(value), -1.0, 1.0) for value in action]
        self.velocity = self.clip(self.velocity + change[0], 0.0, 100.0)
        self.gain = self.clip(self.gain + 10.0 * change[1], 0.0, 100.0)
        self.shift = self.clip(self.shift + _SHIFT_STEP * change[2], 0.0, 100.0)
        fatigue = self._fatigue()
        self.costs.append(self._operational_cost())
        convolved = sum(w * c for w, c in zip(_COST_WEIGHTS, self.costs, strict=False))
        exact = convolved + 25.0 * self._mis_calibration()
        consumption = exact + self._draws.normal() * (1.0 + 0.005 * exact)
        frame = np.array(
            [self.setpoint, self.velocity, self.gain, self.shift, fatigue, consumption]
        )
        return frame, -(3.0 * fatigue + consumption) / 100.0


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


class TunedScalarIndustrialBenchmark(ScalarIndustrialBenchmark):
    """The same machine without NumPy's overhead on single numbers."""

    exp = staticmethod(math.exp)
    clip = staticmethod(_clip)
