"""Pictures of a running session: the proximity as a dial, both copies over time, or on the map."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from components.reporting.policy_maps import PlaneMap

__all__ = ["SessionPast", "session_picture"]

Array = NDArray[np.float64]

_OWN: Final = "#1d4ed8"
_USUAL: Final = "#94a3b8"
_WARNING: Final = "#b45309"
_SIZE: Final = (7.2, 4.48)  # inches; in pixels multiples of 16, which video codecs want
_DPI: Final = 100


@dataclass
class SessionPast:
    """What has happened so far.

    Attributes:
        names: Of the quantities that are shown.
        steps: That will have happened in the end.
        proximity: At which the dial stands.
        proximities: One per step.
        values: Per step the quantities, each for the operated copy and the behaviour, `[2]`, or for
            the operated copy alone, `[1]`.
        trails: Positions `[2]` of both copies in the present episode, on a map.
        strayed: Whether the state has left the log.
    """

    names: Sequence[str]
    steps: int
    proximity: float = 0.0
    proximities: list[float] = field(default_factory=list)
    values: list[list[Array]] = field(default_factory=list)
    trails: tuple[list[Array], list[Array]] = field(default_factory=lambda: ([], []))
    strayed: bool = False


def session_picture(
    past: SessionPast, plane: PlaneMap | None = None, actions: Array | None = None
) -> NDArray[np.uint8]:
    """Draw a session as it stands.

    Args:
        past: What has happened.
        plane: The map, where there is one.
        actions: `[N, 2]` of the policy in the places of the map.

    Returns:
        `[448, 720, 3]`.
    """
    figure = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    dial, below = _beside(figure, 2, 1, height_ratios=[1, 6])
    _draw_dial(dial.subplots(), past)
    if plane is not None and actions is not None:
        left, right = _beside(below, 1, 2, width_ratios=[1.1, 1])
        _draw_map(left.subplots(), plane, actions, past)
        places = np.atleast_1d(right.subplots(len(past.names), 1, sharex=True))
    else:
        columns = 2 if len(past.names) > 3 else 1
        rows = -(-len(past.names) // columns)
        places = np.atleast_1d(below.subplots(rows, columns, sharex=True)).ravel()
    for number, (axes, name) in enumerate(zip(places, past.names, strict=False)):
        _draw_strip(axes, name, np.array([row[number] for row in past.values]), past.steps)
    for axes in places[len(past.names) :]:
        axes.set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def _beside(figure: FigureBase, rows: int, columns: int, **ratios: Any) -> list[Any]:
    """Parts of a figure, each with its own layout."""
    return list(np.atleast_1d(figure.subfigures(rows, columns, **ratios)))


def _draw_dial(axes: Axes, past: SessionPast) -> None:
    now = past.proximity
    axes.set(xlim=(-0.16, 1.16), ylim=(-1.0, 1.4))
    axes.set_axis_off()
    axes.plot([0, 1], [0, 0], color="#e2e8f0", linewidth=7, solid_capstyle="round")
    axes.plot([0, now], [0, 0], color=_OWN, linewidth=7, solid_capstyle="round")
    axes.plot([now], [0], "o", color=_OWN, markersize=15)
    axes.text(-0.03, 0, "familiar", ha="right", va="center")
    axes.text(1.03, 0, "better", ha="left", va="center")
    said = "   the state has left the log" if past.strayed else ""
    colour = _WARNING if past.strayed else _OWN
    axes.text(0.5, 0.75, f"λ = {now:.2f}{said}", ha="center", color=colour, weight="bold")


def _draw_map(axes: Axes, plane: PlaneMap, actions: Array, past: SessionPast) -> None:
    plane.draw(axes, actions, "")
    for trail, colour in zip(reversed(past.trails), ("#475569", _OWN), strict=True):
        if trail:
            places = np.array(trail)
            axes.plot(*places.T, color=colour, linewidth=2.5)
            axes.plot(*places[-1], "o", color=colour, markeredgecolor="white", markersize=10)


def _draw_strip(axes: Axes, name: str, values: Array, steps: int) -> None:
    axes.set_title(name, fontsize="small", loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(0, max(2, steps))
    axes.tick_params(labelsize="x-small")
    if len(values):
        over = np.arange(1, len(values) + 1)
        for copy, colour in reversed(list(enumerate((_OWN, _USUAL)[: values.shape[1]]))):
            axes.plot(over, values[:, copy], color=colour, linewidth=1.5)
