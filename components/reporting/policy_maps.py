"""Policies of the 2-D world as maps: in every place an arrow in the direction of the action.

The layout of thesis figures 6.3 and 6.4, from actions that have been computed. The colour of an
arrow is its direction, its length that of the action.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

__all__ = ["PlaneMap", "log_figure", "panels_figure", "picture", "save_reduced"]

Array = NDArray[np.float64]

_DIRECTIONS: Final = colormaps["hsv"]
_COLUMNS: Final = 7  # panels side by side, as in figure 6.4
_DPI: Final = 150
_COLOURS: Final = 128  # of a reduced picture


@dataclass(frozen=True)
class PlaneMap:
    """What all maps share.

    Attributes:
        side: The square [0, side]^2 is shown.
        places: `[N, 2]` where arrows begin.
        rewards: `[M, M]` on an even grid over the square, rows from y = 0 up.
        goals: `[G, 2]` of the logging controller, drawn as circles.
        centre: Where the reward is greatest, drawn as a cross.
    """

    side: float
    places: Array
    rewards: Array
    goals: Array
    centre: tuple[float, float]

    def draw(
        self,
        axes: Axes,
        actions: Array,
        title: str,
        *,
        ends: Array | None = None,
        stroke: float = 0.007,
    ) -> None:
        """Draw the map of a policy.

        Args:
            axes: Empty ones.
            actions: `[N, 2]` in the places.
            title: Above it.
            ends: `[K, 2]` where trajectories end, drawn as dots.
            stroke: Width of the arrows, of that of the axes.
        """
        self._begin(axes, title)
        angles = np.arctan2(actions[:, 1], actions[:, 0])
        axes.quiver(
            *self.places.T,
            *actions.T,
            color=_DIRECTIONS((angles / (2.0 * np.pi)) % 1.0),
            angles="xy",
            scale_units="xy",
            scale=1.6,
            width=stroke,
            pivot="tail",
        )
        if ends is not None:
            axes.plot(*ends.T, "o", color="black", markersize=3.0, alpha=0.5, linestyle="none")
        self._mark(axes)

    def draw_rewards(self, figure: Figure, axes: Axes, logged: Array, title: str) -> None:
        """Draw the reward, with logged positions `[K, 2]` as dots."""
        self._begin(axes, title)
        shown = axes.imshow(
            self.rewards, origin="lower", extent=(0.0, self.side) * 2, cmap="viridis"
        )
        figure.colorbar(shown, ax=axes, label="reward", shrink=0.85)
        axes.plot(*logged.T, ".", color="white", alpha=0.5, markersize=1.5, linestyle="none")
        self._mark(axes)

    def _begin(self, axes: Axes, title: str) -> None:
        axes.set(xlim=(0.0, self.side), ylim=(0.0, self.side), aspect="equal", title=title)
        axes.set_xticks([0.0, self.side / 2.0, self.side])
        axes.set_yticks([0.0, self.side / 2.0, self.side])

    def _mark(self, axes: Axes) -> None:
        style: dict[str, Any] = {"linestyle": "none", "markeredgecolor": "black"}
        axes.plot(*self.goals.T, "o", markerfacecolor="none", markersize=9.0, **style)
        axes.plot(*self.centre, "X", markerfacecolor="white", markersize=8.0, **style)


def log_figure(plane: PlaneMap, behaviour: Array, logged: Array) -> Figure:
    """Thesis figure 6.3: the logging controller without exploration, and the reward.

    Args:
        plane: What is drawn on.
        behaviour: `[N, 2]` its actions in the places.
        logged: `[K, 2]` positions in the log, drawn on the reward.
    """
    figure = Figure(figsize=(9.4, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    plane.draw(left, behaviour, "logging controller, without exploration")
    plane.draw_rewards(figure, right, logged, "reward, and the logged positions")
    return figure


def panels_figure(plane: PlaneMap, maps: Mapping[float, tuple[Array, Array]]) -> Figure:
    """Thesis figure 6.4: the map of a policy at every proximity.

    Args:
        plane: What is drawn on.
        maps: By proximity the actions `[N, 2]` in the places, and where trajectories end, `[K, 2]`.
    """
    rows = -(-len(maps) // _COLUMNS)
    columns = min(_COLUMNS, len(maps))
    figure = Figure(figsize=(1.2 * columns, 1.38 * rows), layout="constrained")
    figure.subplots(rows, columns, squeeze=False)
    for axes, (proximity, (actions, ends)) in zip(figure.axes, maps.items(), strict=False):
        plane.draw(axes, actions, f"λ = {proximity:.2f}", ends=ends, stroke=0.012)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.title.set_fontsize("small")
    for axes in figure.axes[len(maps) :]:
        axes.set_axis_off()
    return figure


def picture(plane: PlaneMap, proximity: float, actions: Array, ends: Array) -> NDArray[np.uint8]:
    """A picture `[height, width, 3]` of a film over the proximity, with the ends `[K, 2]`."""
    figure = Figure(figsize=(4.8, 4.8), dpi=100, layout="constrained")
    plane.draw(figure.subplots(), actions, f"proximity λ = {proximity:.2f}", ends=ends)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def save_reduced(figure: Figure, path: Path) -> None:
    """Write a PNG of few colours: panels full of coloured arrows take a fifth of the bytes."""
    figure.savefig(path, dpi=_DPI)
    with Image.open(path) as drawn:
        reduced = drawn.convert("RGB").quantize(_COLOURS)
    reduced.save(path, optimize=True, dpi=(_DPI, _DPI))
