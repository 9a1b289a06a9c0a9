"""Fatigue of N machines: effective velocity and gain, their hidden state, and its saturation.

Equations 3.17-3.27 for all copies, in buffers allocated once; the deviations from the thesis are
named in `benchmark.py`.
"""

import numpy as np
from numpy.typing import NDArray

from components.environments.industrial.arithmetic import choice, number
from components.environments.industrial.noise import NoiseSource

__all__ = ["Fatigue"]

Array = NDArray[np.float64]

_CAP = number(5.0)
_GROWTH, _DECAY, _THIRD = number(1.1), number(0.9), number(1.0 / 3.0)
_GROWS_FROM, _TAKEN_UP_TO = number(1.2), number(0.05)
_VELOCITY_OFFSET, _NUMERATOR, _GAIN_RATE = number(20.0), number(6000.0), number(0.01)
_ZERO, _ONE, _TWO_THIRDS = number(0.0), number(1.0), number(2.0 / 3.0)


class Fatigue:
    """The fatigue of N copies with one setpoint.

    Args:
        copies: N.
        setpoint: load demanded from the machine, 0 ... 100.

    Attributes:
        hidden: `[2, N]` mu of equations 3.26 and 3.27, velocity first.
        effective: `[2, N]` effective velocity and gain (equations 3.20-3.23).
        basic: `[N]` basic fatigue, before it is amplified.
    """

    def __init__(self, copies: int, setpoint: float) -> None:
        self.hidden, self.effective = np.zeros((2, copies)), np.zeros((2, copies))
        self.basic = np.zeros(copies)
        self.demand(setpoint)
        # whole arrays of limits: NumPy is twice as fast on them as on broadcast numbers
        self._ones, self._caps = np.ones((2, copies)), np.full((2, copies), _CAP)
        self._pair, self._grown, self._sign = np.empty((3, 2, copies))
        self._fatigue, self._scratch = np.empty((2, copies))
        self._mask = np.empty(copies, dtype=np.bool_)
        self._grow = choice(self.hidden, self._sign, self._grown)
        self._take_effective = choice(self.hidden, self._sign, self.effective)

    def demand(self, setpoint: float) -> None:
        """Take the coefficients of effective velocity and gain (equations 3.20-3.23) at a setpoint.

        Both have the form numerator / (steering + shift) + offset.
        """
        p = setpoint

        def gain(g: float) -> float:
            return 1.0 / (g + p + 1.0)

        def velocity(v: float, g: float) -> float:
            return (g + p + 2.0) / (v - p + 101.0)

        gain_scale = 1.0 / (gain(0.0) - gain(100.0))
        span = velocity(100.0, 0.0) - velocity(0.0, 100.0)
        self._velocity_scale = number(-1.0 / span)
        offsets = (1.0 + velocity(0.0, 100.0) / span, -gain(100.0) * gain_scale)
        self._effective_offsets = np.array(offsets)[:, None]
        self._effective_shifts = np.array((101.0 - p, p + 1.0))[:, None]
        self._numerator = np.full(self.hidden.shape, gain_scale)  # the gain's row never changes

    def step(self, steerings: Array, source: NoiseSource) -> Array:
        """Move the hidden state by one step.

        Args:
            steerings: `[3, N]` velocity, gain and shift after the action.
            source: draws of this step.

        Returns:
            `[N]` the fatigue, a buffer that the next step overwrites.
        """
        velocity, gain = steerings[0], steerings[1]
        effective = self.effective
        scratch = self._scratch

        denominator, numerator = self._pair, self._numerator
        np.add(steerings[:2], self._effective_shifts, out=denominator)
        np.add(denominator[1], _ONE, out=numerator[0])
        np.multiply(numerator[0], self._velocity_scale, out=numerator[0])
        np.divide(numerator, denominator, out=effective)
        effective += self._effective_offsets

        base, uniform, binary = source.fatigue(effective)
        noise = self._pair
        np.subtract(self._ones, base, out=noise)
        noise *= uniform
        noise *= binary
        noise *= effective
        noise += base

        amplification = self._fatigue
        np.maximum(noise[0], noise[1], out=amplification)
        self._move_hidden(noise)
        self._saturate(source)

        basic = self.basic
        np.add(velocity, _VELOCITY_OFFSET, out=basic)
        np.divide(_NUMERATOR, basic, out=basic)
        np.multiply(gain, gain, out=scratch)
        scratch *= _GAIN_RATE
        basic -= scratch
        np.maximum(basic, _ZERO, out=basic)
        amplification *= _TWO_THIRDS
        amplification += _THIRD
        amplification *= basic
        return amplification

    def _move_hidden(self, noise: Array) -> None:
        """Equations 3.26 and 3.27: below 1.2 it follows the noise, which is lost, then it grows."""
        hidden, grown = self.hidden, self._grown
        np.multiply(hidden, _GROWTH, out=grown)
        np.minimum(grown, self._caps, out=grown)
        np.subtract(hidden, _GROWS_FROM, out=self._sign)
        hidden *= _DECAY
        noise *= _THIRD
        hidden += noise
        self._grow()
        # an effective value of at most 0.05 takes its place
        np.subtract(_TAKEN_UP_TO, self.effective, out=self._sign)
        self._take_effective()

    def _saturate(self, source: NoiseSource) -> None:
        """Equation 3.19 where the hidden state has reached its cap."""
        room = self._scratch
        np.maximum(self.hidden[0], self.hidden[1], out=room)
        np.greater_equal(room, _CAP, out=self._mask)
        saturated = source.saturation(self._mask)
        if np.count_nonzero(self._mask):
            room -= _CAP
            choice(self._fatigue, room, saturated)()

    def replace(self, chosen: NDArray[np.intp], other: "Fatigue") -> None:
        """Give the copies `chosen [M]` the state of `other`, which has M copies."""
        self.hidden[:, chosen] = other.hidden
        self.effective[:, chosen] = other.effective
        self.basic[chosen] = other.basic
