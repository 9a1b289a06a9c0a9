"""Mis-calibration of N machines: the effective shift, its hidden oscillator and their penalty.

The potential and the transitions of the oscillator's latents are tabulated in `goldstone.py`; here
they are evaluated for all copies, in buffers allocated once.
"""

import numpy as np
from numpy.typing import NDArray

from components.environments.industrial.arithmetic import SIGN_BIT, number
from components.environments.industrial.goldstone import ALPHA, BETA, SAFE_ZONE, GoldstoneTables

__all__ = ["MisCalibration"]

Array = NDArray[np.float64]

# A power of zero takes many times as long as one of any other number, and this far below one
# the result cannot be told from zero beside anything it is added to.
_SMALLEST_EXCESS = number(1e-140)
_SHIFT_RATE, _LOWEST, _HIGHEST = number(0.05), number(-1.5), number(1.5)
_SAFE_ZONE, _ALPHA, _BETA = number(SAFE_ZONE), number(ALPHA), number(BETA)


class MisCalibration:
    """The mis-calibration of N copies with one setpoint.

    Args:
        copies: N.
        setpoint: load demanded from the machine, 0 ... 100.

    Attributes:
        latents: `[N]` column of `GoldstoneTables` of domain, response and direction.
        shift: `[N]` effective shift (equation 3.5).
        potential: `[N]` Goldstone potential (equation 3.6), at least -1.
    """

    def __init__(self, copies: int, setpoint: float) -> None:
        self.latents = np.zeros(copies, dtype=np.intp)
        self.shift, self.potential = np.zeros(copies), np.zeros(copies)
        self.demand(setpoint)
        self._tables = GoldstoneTables.build()
        self._scaled, self._excess, self._constant = np.empty((3, copies))
        self._side = self._scaled.view(np.int64)
        self._index = np.empty(copies, dtype=np.intp)

    def demand(self, setpoint: float) -> None:
        """Take the centre of the effective shift at a setpoint (equation 3.5)."""
        self._offset = number(setpoint / 50.0 + 1.5)

    def step(self, steering: Array) -> None:
        """Follow the steering `[N]` of the shift (equations 3.5, 3.6 and 3.9-3.16)."""
        tables, shift, side, index = self._tables, self.shift, self._scaled, self._index
        np.multiply(steering, _SHIFT_RATE, out=shift)
        shift -= self._offset
        np.maximum(shift, _LOWEST, out=shift)
        np.minimum(shift, _HIGHEST, out=shift)

        # one column to the right above the safe zone, one to the left below it
        np.subtract(_SAFE_ZONE, shift, out=side)
        np.right_shift(self._side, SIGN_BIT, out=self._side)
        np.subtract(self.latents, self._side, out=index)
        np.add(shift, _SAFE_ZONE, out=side)
        np.right_shift(self._side, SIGN_BIT, out=self._side)
        index += self._side
        latents = self.latents
        tables.transition.take(index, out=latents, mode="clip")

        # up to the radius omega is linear, beyond it a power of the excess is added
        scaled, excess, constant = self._scaled, self._excess, self._constant
        np.abs(shift, out=scaled)
        tables.radius.take(latents, out=constant, mode="clip")
        np.subtract(scaled, constant, out=excess)
        np.maximum(excess, _SMALLEST_EXCESS, out=excess)
        np.minimum(scaled, constant, out=scaled)
        tables.slope.take(latents, out=constant, mode="clip")
        scaled *= constant
        tables.exponent.take(latents, out=constant, mode="clip")
        np.power(excess, constant, out=excess)
        tables.factor.take(latents, out=constant, mode="clip")
        excess *= constant
        scaled += excess

        potential = self.potential
        tables.bias.take(latents, out=potential, mode="clip")
        np.copysign(scaled, shift, out=excess)
        potential *= excess
        scaled *= scaled
        np.multiply(scaled, _BETA, out=excess)
        excess -= _ALPHA
        excess *= scaled
        potential += excess

    def replace(self, chosen: NDArray[np.intp], other: "MisCalibration") -> None:
        """Give the copies `chosen [M]` the state of `other`, which has M copies."""
        self.latents[chosen] = other.latents
        self.shift[chosen] = other.shift
        self.potential[chosen] = other.potential
