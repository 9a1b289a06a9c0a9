"""One figure per dataset: policies over the proximity parameter, the others as dashed lines.

The layout of thesis figure 6.5. Everything is drawn from stored summaries.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from components.reporting.edge_names import name_levels

__all__ = ["limits", "proximity_figure", "save_figure"]

BEHAVIOUR_COLOUR = "0.4"

Summary = Mapping[str, Any]


def proximity_figure(
    dataset: str,
    summaries: Sequence[Summary],
    behaviour_return: float,
    about: str = "",
    colours: Mapping[str, str] = {},
) -> Figure | None:
    """Draw a dataset's adaptive policies over the proximity parameter.

    Args:
        dataset: Its name.
        summaries: All summaries of this dataset; those whose points carry a proximity (stored as
            `lambda`) are curves, the others dashed lines.
        behaviour_return: Mean return of the logging controller, exploration included; NaN if it
            is not counted as the policies' returns are.
        about: For the title: profile and seeds.
        colours: By algorithm; others take the next of matplotlib's.

    Returns:
        The figure, or None where no policy takes the parameter.
    """
    curves = [s for s in summaries if s["points"][0]["lambda"] is not None]
    fixed = [s for s in summaries if s["points"][0]["lambda"] is None]
    if not curves:
        return None
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    tints = {s["algorithm"]: f"C{number}" for number, s in enumerate([*curves, *fixed])}
    tints |= {name: colours[name] for name in tints if name in colours}
    levels = [(behaviour_return, "logged behaviour", BEHAVIOUR_COLOUR)]
    for summary in curves:
        points, colour = summary["points"], tints[summary["algorithm"]]
        x = [p["lambda"] for p in points]
        mean = [p["mean"] for p in points]
        band = [p["seed_std"] for p in points]
        upper.plot(x, mean, color=colour, linewidth=1.8)
        upper.fill_between(
            x,
            [m - b for m, b in zip(mean, band, strict=True)],
            [m + b for m, b in zip(mean, band, strict=True)],
            color=colour,
            alpha=0.2,
            linewidth=0,
        )
        levels.append((mean[-1], summary["algorithm"], colour))
        lower.plot(x, [p["distance"] for p in points], color=colour, linewidth=1.8)
    for summary in fixed:
        level, colour = summary["points"][0]["mean"], tints[summary["algorithm"]]
        upper.axhline(level, color=colour, linestyle="--", linewidth=1.2)
        levels.append((level, summary["algorithm"], colour))
    upper.axhline(behaviour_return, color=BEHAVIOUR_COLOUR, linestyle=":", linewidth=1.2)
    bands = [(p["mean"], p["seed_std"]) for s in curves for p in s["points"]]
    shown = [behaviour_return, *(mean + side * band for mean, band in bands for side in (-1, 1))]
    upper.set_ylim(limits(shown, [s["points"][0]["mean"] for s in fixed]))
    known = [level for level in levels if not math.isnan(behaviour_return) or level != levels[0]]
    name_levels(upper, known)
    upper.set_title(f"{dataset} ({about})" if about else dataset, fontsize="medium")
    upper.set_ylabel("discounted return\nmean ± deviation of the seeds")
    lower.set_ylabel("distance to\nbehaviour policy")
    lower.set_xlabel("proximity parameter λ")
    lower.set_xlim(0.0, 1.0)
    lower.set_ylim(bottom=0.0)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    return figure


def limits(shown: Sequence[float], others: Sequence[float]) -> tuple[float, float]:
    """Ends of an axis of returns: what has to be shown, and others not far below.

    The range of a diverged learner would hide all differences; its level is named at the edge.
    """
    finite = [value for value in shown if math.isfinite(value)] or [0.0]
    low, high = min(finite), max(finite)
    far = low - (high - low)
    near = [value for value in others if math.isfinite(value) and value >= far]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's ending."""
    figure.savefig(path, dpi=150)
