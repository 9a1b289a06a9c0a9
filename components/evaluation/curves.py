"""What a curve of returns over a trade-off says: first drop, peak, area, zigzag.

A curve is a sequence of mean returns, the most cautious setting first: proximities from 0 to 1, or
MOPO's penalties from the largest down. Pure functions of it, whoever has measured it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Shape", "first_drop", "shape_of"]


@dataclass(frozen=True)
class Shape:
    """The shape of a curve, in units of return.

    Attributes:
        peak: The greatest return.
        at: Its place, the first of equals.
        area: Mean return over the whole range of settings, as if each was as likely (trapezoids).
        greatest_fall: From one setting to the next, at least 0.
        zigzag: Total variation beyond that of a curve which rises to its peak and then falls: 0
            exactly where the curve has a single hump, which is what an operator can climb.
    """

    peak: float
    at: int
    area: float
    greatest_fall: float
    zigzag: float


def first_drop(returns: Sequence[float] | npt.NDArray[np.floating]) -> tuple[int, int]:
    """The strategy of thesis 6.6.1: go on while the return rises, stop at the first drop.

    Args:
        returns: ``[N]`` of the settings, the most cautious first.

    Returns:
        The place of the final setting, and how many settings were tried (the drop included). A
        return that equals the best so far is neither better nor worse: the search goes on, and the
        earlier setting stays the final one.

    Raises:
        ValueError: The curve is empty or undefined somewhere.
    """
    values = _checked(returns)
    best = 0
    for place in range(1, len(values)):
        if values[place] < values[best]:
            return best, place + 1
        if values[place] > values[best]:
            best = place
    return best, len(values)


def shape_of(
    returns: Sequence[float] | npt.NDArray[np.floating],
    settings: Sequence[float] | npt.NDArray[np.floating] | None = None,
) -> Shape:
    """The shape of a curve.

    Args:
        returns: ``[N]``, the most cautious setting first.
        settings: ``[N]`` where they lie, rising or falling; None: evenly spaced.

    Raises:
        ValueError: The curve is empty or undefined somewhere, or settings are not in order.
    """
    values = _checked(returns)
    places = np.linspace(0, 1, len(values)) if settings is None else np.asarray(settings, float)
    steps = np.diff(places)
    if places.shape != values.shape or not ((steps > 0).all() or (steps < 0).all()):
        raise ValueError("A curve needs one setting per return, in rising or in falling order.")
    changes = np.diff(values)
    at = int(values.argmax())
    peak, first, last = values[at], values[0], values[-1]
    middles = (values[1:] + values[:-1]) / 2
    area = float((middles * steps).sum() / steps.sum()) if len(steps) else float(peak)
    # Rounding may leave a tiny negative number of a curve that has a single hump.
    zigzag = max(0.0, float(np.abs(changes).sum() - (2 * peak - first - last)))
    return Shape(float(peak), at, area, float(max(0.0, -changes.min(initial=0.0))), zigzag)


def _checked(returns: Sequence[float] | npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    values = np.asarray(returns, dtype=np.float64)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise ValueError("A curve needs at least one return, and all of them defined.")
    return values
