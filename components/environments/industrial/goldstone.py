"""Mis-calibration of the Industrial Benchmark: a linearly biased Goldstone potential.

The penalty depends on the effective shift and on three latent variables (domain, response and
direction, thesis equations 3.9-3.16). The latents take 2 x 2 x 13 values and move by the sign of
the effective shift alone, so both the latent transition and the constants of the potential are
small tables, which a vectorised environment reads by one index per copy.

Source: thesis equations 3.6 and 3.9-3.16. Deviations, all demanded by the recordings of the
reference implementation: the safe zone is sin(15 deg)/2 = 0.1294 (the thesis prints 0.1309), and
the rescaling of the shift, which the thesis leaves to a citation, is given in `omega` below.

The reference prints the constants of the potential with four or five digits. To machine precision
they follow from three conditions: without bias the minimum lies at 1 (alpha = 2 beta),
kappa / alpha = -sqrt(32 / 27), and with full bias the potential's minimum is -1.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "ALPHA",
    "BETA",
    "KAPPA",
    "MAX_DIRECTION",
    "SAFE_ZONE",
    "GoldstoneTables",
    "decode_latents",
    "encode_latents",
    "latent_step",
    "omega",
    "potential",
]

MAX_DIRECTION = 6
"""Largest absolute direction index; 24 direction indices make a full turn."""

SAFE_ZONE = math.sin(math.radians(15.0)) / 2.0
"""Half width of the effective shift's safe zone."""

_REQUIRED_STEP = math.sin(math.radians(15.0))
_BIAS = math.sqrt(32.0 / 27.0)


def _largest_root(bias: float) -> float:
    """Largest real root of w^3 - w - bias / 2, the location of the biased potential's minimum."""
    root = 1.0 + 0.3 * bias
    for _ in range(50):  # Newton from the right of the root: monotone, quadratic
        root -= (root**3 - root - bias / 2.0) / (3.0 * root**2 - 1.0)
    return root


_FULL_BIAS_MINIMUM = _largest_root(_BIAS)
ALPHA = 1.0 / (_FULL_BIAS_MINIMUM**2 - _FULL_BIAS_MINIMUM**4 / 2.0 + _BIAS * _FULL_BIAS_MINIMUM)
BETA = ALPHA / 2.0
KAPPA = -_BIAS * ALPHA


def _direction_sine(direction: int) -> float:
    return math.sin(math.pi * direction / 12.0)


@functools.cache
def _minimum_constants(direction: int) -> tuple[float, float]:
    """Shift at which the penalty is least, and the rescaled value it is mapped to."""
    rho = abs(_direction_sine(direction))
    return max(rho, _REQUIRED_STEP), _largest_root(_BIAS * rho)


def omega(direction: int, effective_shift: float) -> float:
    """Rescale the effective shift so that the potential's minimum lies at max(|rho|, sin 15 deg).

    Odd in the shift. Linear up to the minimum, beyond it a power law that reaches 2 at 2 with
    slope 1.

    Args:
        direction: direction index, -6 ... 6.
        effective_shift: effective shift, -1.5 ... 1.5.
    """
    radius, minimum = _minimum_constants(direction)
    size = abs(effective_shift)
    if size <= radius:
        return effective_shift * minimum / radius
    exponent = (2.0 - radius) / (2.0 - minimum)
    factor = (2.0 - minimum) / (2.0 - radius) ** exponent
    return math.copysign(minimum + factor * (size - radius) ** exponent, effective_shift)


def potential(direction: int, effective_shift: float) -> float:
    """Goldstone potential (thesis equation 3.6); its minimum over all arguments is -1."""
    scaled = omega(direction, effective_shift)
    rho = _direction_sine(direction)
    return -ALPHA * scaled**2 + BETA * scaled**4 + KAPPA * rho * scaled


def latent_step(
    domain: int, response: int, direction: int, shift_sign: int
) -> tuple[int, int, int]:
    """One transition of the latents (thesis equations 3.9-3.16).

    Args:
        domain: -1 or +1.
        response: +1 advantageous, -1 disadvantageous.
        direction: -6 ... 6.
        shift_sign: sign of the effective shift, 0 inside the safe zone.

    Returns:
        The next (domain, response, direction).
    """
    new_domain = shift_sign if shift_sign != 0 else domain
    if new_domain != domain:
        response = 1
    if shift_sign == 0:
        direction -= (direction > 0) - (direction < 0)
    elif direction != -MAX_DIRECTION * new_domain:
        direction += response * shift_sign
    if abs(direction) >= MAX_DIRECTION:
        response = -1
        turn = 4 * MAX_DIRECTION
        direction = turn // 2 - (direction + turn) % turn
    if direction == 0 and shift_sign == 0:
        return 1, 1, 0
    return new_domain, response, direction


_DIRECTIONS = 2 * MAX_DIRECTION + 1


def encode_latents(domain: int, response: int, direction: int) -> int:
    """Index of a latent state in 0 ... 51.

    Raises:
        ValueError: a value outside its range.
    """
    if domain not in (-1, 1) or response not in (-1, 1) or abs(direction) > MAX_DIRECTION:
        raise ValueError(
            f"latent state (domain {domain}, response {response}, direction {direction}) does not "
            f"exist: domain and response are -1 or 1, direction is an integer from -6 to 6."
        )
    return ((domain > 0) * 2 + (response > 0)) * _DIRECTIONS + direction + MAX_DIRECTION


def decode_latents(index: int) -> tuple[int, int, int]:
    """(domain, response, direction) of a latent index; the inverse of `encode_latents`."""
    pair, direction = divmod(index, _DIRECTIONS)
    return (1 if pair >= 2 else -1), (1 if pair % 2 else -1), direction - MAX_DIRECTION


@dataclass(frozen=True)
class GoldstoneTables:
    """Tables over the 52 latent states, three columns each, so that a step needs no arithmetic.

    Column 3 * state + 1 + sign belongs to a state and the sign of the next effective shift (0 in
    the safe zone).

    Attributes:
        transition: `[156]` middle column of the next state.
        radius: `[156]` shift up to which `omega` is linear; equal in a state's three columns, as
            are all of the following.
        slope: of the linear part.
        factor: of the power law beyond it.
        exponent: of the power law.
        bias: kappa times rho.
    """

    transition: NDArray[np.intp]
    radius: NDArray[np.float64]
    slope: NDArray[np.float64]
    factor: NDArray[np.float64]
    exponent: NDArray[np.float64]
    bias: NDArray[np.float64]

    @classmethod
    def build(cls) -> "GoldstoneTables":
        """Tabulate `latent_step` and the constants of `omega` and `potential`."""
        states = range(4 * _DIRECTIONS)
        transition = [
            3 * encode_latents(*latent_step(*decode_latents(state), sign)) + 1
            for state in states
            for sign in (-1, 0, 1)
        ]
        rows: list[Sequence[float]] = []
        for state in states:
            direction = decode_latents(state)[2]
            radius, minimum = _minimum_constants(direction)
            exponent = (2.0 - radius) / (2.0 - minimum)
            factor = (2.0 - minimum) / (2.0 - radius) ** exponent
            bias = KAPPA * _direction_sine(direction)
            row = (radius, minimum / radius, factor, exponent, bias)
            rows.extend([row] * 3)
        columns = np.ascontiguousarray(np.array(rows, dtype=np.float64).T)
        return cls(np.array(transition, dtype=np.intp), *columns)
