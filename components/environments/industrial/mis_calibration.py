"""Mis-calibration of N machines: the effective shift, its hidden oscillator and their penalty.

The potential and the transitions of the oscillator's latents are tabulated in `goldstone.py`; here
they are evaluated for all copies, in buffers allocated once.
"""

import numpy as np
from numpy.typing import NDArray

from components.environments.industrial.goldstone import ALPHA, BETA, SAFE_ZONE, GoldstoneTables

__all__ = ["MisCalibration"]

Array = NDArray[np.float64]


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
        self._offset = setpoint / 50.0 + 1.5
        self._tables = GoldstoneTables.build()
        self._scaled, self._excess, self._constant = np.empty((3, copies))
        self._mask = np.empty(copies, dtype=np.bool_)
        self._index = np.empty(copies, dtype=np.intp)

    def step(self, steering: Array) -> None:
        """Follow the steering `[N]` of the shift (equations 3.5, 3.6 and 3.9-3.16)."""
        tables, shift, mask, index = self._tables, self.shift, self._mask, self._index
        np.multiply(steering, 0.05, out=shift)
        shift -= self._offset
        np.maximum(shift, -1.5, out=shift)
        np.minimum(shift, 1.5, out=shift)

        np.greater(shift, SAFE_ZONE, out=mask)
        np.add(self.latents, mask, out=index)
        np.less(shift, -SAFE_ZONE, out=mask)
        index -= mask
        latents = self.latents
        tables.transition.take(index, out=latents, mode="clip")

        # up to the radius omega is linear, beyond it a power of the excess is added
        scaled, excess, constant = self._scaled, self._excess, self._constant
        np.abs(shift, out=scaled)
        tables.radius.take(latents, out=constant, mode="clip")
        np.subtract(scaled, constant, out=excess)
        np.maximum(excess, 0.0, out=excess)
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
        np.multiply(scaled, BETA, out=excess)
        excess -= ALPHA
        excess *= scaled
        potential += excess

    def replace(self, chosen: NDArray[np.intp], other: "MisCalibration") -> None:
        """Give the copies `chosen [M]` the state of `other`, which has M copies."""
        self.latents[chosen] = other.latents
        self.shift[chosen] = other.shift
        self.potential[chosen] = other.potential
