"""One figure per dataset: policies over the proximity parameter, the others as dashed lines.

The layout of thesis figure 6.5. Everything is drawn from stored summaries.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure
from PIL import Image

__all__ = ["proximity_figure", "save_figure"]

Summary = Mapping[str, Any]
_DPI: Final = 150


def proximity_figure(
    dataset: str, summaries: Sequence[Summary], behaviour_return: float
) -> Figure | None:
    """Draw a dataset's adaptive policies over the proximity parameter.

    Args:
        dataset: Its name.
        summaries: All summaries of this dataset; those whose points carry a proximity (stored as
            `lambda`) are curves, the others dashed lines.
        behaviour_return: Mean return of the logging controller, exploration included.

    Returns:
        The figure, or None where no policy takes the parameter.
    """
    curves = [s for s in summaries if s["points"][0]["lambda"] is not None]
    fixed = [s for s in summaries if s["points"][0]["lambda"] is None]
    if not curves:
        return None
    figure = Figure(figsize=(5.6, 5.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    for number, summary in enumerate(curves):
        points, colour = summary["points"], f"C{number}"
        x = [p["lambda"] for p in points]
        mean = [p["mean"] for p in points]
        band = [p["seed_std"] for p in points]
        label = summary["algorithm"]
        upper.plot(x, mean, color=colour, label=f"{label} (mean ± sd of seeds)", linewidth=1.8)
        upper.fill_between(
            x,
            [m - b for m, b in zip(mean, band, strict=True)],
            [m + b for m, b in zip(mean, band, strict=True)],
            color=colour,
            alpha=0.2,
            linewidth=0,
        )
        lower.plot(x, [p["distance"] for p in points], color=colour, linewidth=1.8)
    for number, summary in enumerate(fixed, start=len(curves)):
        upper.axhline(
            summary["points"][0]["mean"],
            color=f"C{number}",
            linestyle="--",
            linewidth=1.2,
            label=f"{summary['algorithm']} ({summary['points'][0]['mean']:.0f})",
        )
    upper.axhline(
        behaviour_return, color="0.4", linestyle=":", linewidth=1.2, label="logged behaviour"
    )
    upper.set_ylim(_limits(curves, fixed, behaviour_return))
    upper.set_title(dataset)
    upper.set_ylabel("discounted 100-step return")
    upper.legend(fontsize="small", edgecolor="none", framealpha=0.9)  # over lines of other policies
    lower.set_ylabel("distance to\nbehaviour policy")
    lower.set_xlabel("proximity parameter λ")
    lower.set_xlim(0.0, 1.0)
    lower.set_ylim(bottom=0.0)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    return figure


def _limits(
    curves: Sequence[Summary], fixed: Sequence[Summary], behaviour_return: float
) -> tuple[float, float]:
    """Returns shown: the curves, the behaviour, and fixed policies not far below them.

    The range of a diverged learner would hide all differences; its mean is given in the legend.
    """
    bands = [(p["mean"], p["seed_std"]) for s in curves for p in s["points"]]
    shown = [mean + side * band for mean, band in bands for side in (-1, 1)]
    shown = [behaviour_return, *filter(math.isfinite, shown)]
    low, high = min(shown), max(shown)
    far = low - (high - low)
    near = [s["points"][0]["mean"] for s in fixed if s["points"][0]["mean"] >= far]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def save_figure(figure: Figure, path: Path, colours: int | None = None) -> None:
    """Write a PNG.

    Args:
        figure: What to draw.
        path: Ends in .png.
        colours: Number of colours to which the picture is reduced; None: it keeps all. Maps full
            of coloured arrows take a fifth of the bytes, and look the same.
    """
    figure.savefig(path, dpi=_DPI)
    if colours is not None:
        with Image.open(path) as drawn:
            reduced = drawn.convert("RGB").quantize(colours)
        reduced.save(path, optimize=True, dpi=(_DPI, _DPI))
