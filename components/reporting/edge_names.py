"""Names of levels beside a figure's right edge, where they cover no line.

What lies beyond the axis is named at its edge, with an arrow.
"""

import math
from collections.abc import Sequence
from typing import Final

from matplotlib.axes import Axes

__all__ = ["Level", "name_levels"]

_APART: Final = 0.052  # least distance of two names as a share of the axis

Level = tuple[float, str, str]
"""A level, what to call it, and its colour."""


def name_levels(axes: Axes, levels: Sequence[Level], share: float = 1.0) -> None:
    """Write the names of levels to the right of an axis whose limits are set.

    Args:
        axes: Which.
        levels: What to name; what is not finite has no place and stands at the bottom.
        share: Height of the axes as a share of a usual one: names keep their distance in inches.
    """
    low, high = axes.get_ylim()
    apart = _APART / share
    wanted = []
    for value, name, colour in levels:
        place = (value - low) / (high - low) if math.isfinite(value) else -math.inf
        sign = " ↓" if place < 0 else " ↑" if place > 1 else ""
        said = f"{value:.0f}" if math.isfinite(value) else "not finite"
        wanted.append((min(max(place, 0.0), 1.0), f"{name} {said}{sign}", colour))
    wanted.sort(key=lambda item: item[0])
    for place, (_, text, colour) in zip(
        _spread([w[0] for w in wanted], apart), wanted, strict=True
    ):
        axes.annotate(
            text,
            (1.0, place),
            (4, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            va="center",
            fontsize="small",
            color=colour,
            annotation_clip=False,
        )


def _spread(places: Sequence[float], apart: float) -> list[float]:
    """Ascending places moved up, and then down from the top, until they are apart."""
    found = list(places)
    for number in range(1, len(found)):
        found[number] = max(found[number], found[number - 1] + apart)
    top = 1.0
    for number in reversed(range(len(found))):
        found[number] = min(found[number], top)
        top = found[number] - apart
    return found
