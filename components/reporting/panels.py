"""Panels of returns, one per dataset, as in the figures of thesis chapter 6.

Each shows lines over the same quantity (the proximity, a penalty, a wanted return, updates) with
the deviation of the seeds as a band, and the logged behaviour as a dotted level; below it, where
they are known, the distances to the behaviour policy. Names and colours stand once, in a legend.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from components.reporting.figures import BEHAVIOUR_COLOUR, limits

__all__ = ["Line", "Panel", "panels_figure"]

Array = NDArray[np.float64]

_COLUMNS: Final = 4  # panels side by side


@dataclass(frozen=True)
class Line:
    """A curve of a panel.

    Attributes:
        name: In the legend; lines of one name have one colour in all panels.
        x: ``[N]`` ascending.
        mean: ``[N]`` returns.
        deviation: ``[N]`` of the seeds; None for no band.
        distance: ``[N]`` to the behaviour policy; None where it is not shown.
        decisive: Whether the range of the returns must hold it; others may leave the panel below.
    """

    name: str
    x: Array
    mean: Array
    deviation: Array | None = None
    distance: Array | None = None
    decisive: bool = True


@dataclass(frozen=True)
class Panel:
    """What is shown of a dataset.

    Attributes:
        title: Above it.
        level: Mean return of the logged behaviour; NaN where it cannot be compared.
        lines: The curves.
        mark: A point of the curves to point out, as ``(x, return)``; None for none.
    """

    title: str
    level: float
    lines: Sequence[Line]
    mark: tuple[float, float] | None = None


def panels_figure(
    panels: Sequence[Panel],
    below: str,
    *,
    beside: str = "discounted return",
    level: str = "logged behaviour",
    backwards: bool = False,
    logarithmic: bool = False,
) -> Figure:
    """Draw panels side by side.

    Args:
        panels: At least one.
        below: Label of the horizontal axes.
        beside: Label of the vertical axes.
        level: Name of the dotted level.
        backwards: Whether x falls from left to right, as penalties do towards freer policies.
        logarithmic: Whether x is shown by its order of magnitude, and 0 below all others.
    """
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    distances = any(line.distance is not None for panel in panels for line in panel.lines)
    heights = [2.2, 1.0] if distances else [1.0]
    tall = 3.3 if distances else 2.5
    figure = Figure(figsize=(max(4.6, 3.1 * columns), tall * rows + 0.5), layout="constrained")
    grid = figure.subplots(
        rows * len(heights), columns, squeeze=False, sharex=False, height_ratios=heights * rows
    )
    names = list(dict.fromkeys(line.name for panel in panels for line in panel.lines))
    tints = {name: f"C{number}" for number, name in enumerate(names)}
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        axes = grid[row * len(heights) : (row + 1) * len(heights), column]
        _draw(panel, list(axes), tints)
        for part in axes:
            if backwards:
                part.invert_xaxis()
            if logarithmic:
                least = min(float(line.x[line.x > 0].min()) for line in panel.lines)
                part.set_xscale("symlog", linthresh=least, linscale=0.5)
        if column == 0:
            axes[0].set_ylabel(beside)
            if distances:
                axes[1].set_ylabel("distance")
        axes[-1].set_xlabel(below)
    for number in range(len(panels), rows * columns):
        row, column = divmod(number, columns)
        for axes in grid[row * len(heights) : (row + 1) * len(heights), column]:
            axes.set_axis_off()
    named = [grid[0, 0].plot([], [], color=tints[name], linewidth=1.6)[0] for name in names]
    if any(math.isfinite(panel.level) for panel in panels):
        named.append(grid[0, 0].plot([], [], ":", color=BEHAVIOUR_COLOUR)[0])
        names.append(level)
    _fit_legend(figure, named, names)
    return figure


def _fit_legend(figure: Figure, named: Sequence[Line2D], names: Sequence[str]) -> None:
    """A legend below the panels, in as many columns as the figure is wide enough for."""
    for columns in range(min(4, len(names)), 0, -1):
        legend = figure.legend(
            named, names, loc="outside lower center", ncols=columns, frameon=False
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def _draw(panel: Panel, parts: Sequence[Axes], tints: dict[str, str]) -> None:
    upper = parts[0]
    needed: list[float] = [panel.level]
    others: list[float] = []
    for line in panel.lines:
        colour = tints[line.name]
        spread = np.zeros_like(line.mean) if line.deviation is None else line.deviation
        upper.plot(line.x, line.mean, color=colour, linewidth=1.6)
        upper.fill_between(
            line.x, line.mean - spread, line.mean + spread, color=colour, alpha=0.2, linewidth=0
        )
        shown = [*(line.mean - spread).tolist(), *(line.mean + spread).tolist()]
        (needed if line.decisive else others).extend(shown)
        if line.distance is not None:
            parts[1].plot(line.x, line.distance, color=colour, linewidth=1.6)
    upper.axhline(panel.level, color=BEHAVIOUR_COLOUR, linestyle=":", linewidth=1.2)
    if panel.mark is not None:
        upper.plot(*panel.mark, "o", color="black", markersize=5.0, markerfacecolor="none")
    upper.set_ylim(limits(needed, others))
    upper.set_title(panel.title, fontsize="medium")
    for axes in parts:
        axes.margins(x=0.0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    if len(parts) > 1:
        parts[1].set_ylim(bottom=0.0)
