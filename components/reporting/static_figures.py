"""Every figure of a report for print: training curves, panels over λ, comparisons of algorithms."""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from components.reporting.edge_names import name_levels
from components.reporting.evidence import Across, Cell, Evidence
from components.reporting.figures import BEHAVIOUR_COLOUR, limits, proximity_figure
from components.reporting.page_data import colours

__all__ = ["static_figures"]


def static_figures(evidence: Evidence) -> Iterator[tuple[str, Figure]]:
    """The figures, each with the name of its file."""
    for dataset, log in evidence.logs.items():
        cells = evidence.comparable_on(dataset)
        level = math.nan if log.level is None else log.level
        if cells:
            yield f"curves-{dataset}", _curves(evidence, dataset, cells, level)
        summaries = [{"algorithm": cell.algorithm, "points": cell.points} for cell in cells]
        tints = colours(evidence.algorithms)
        figure = proximity_figure(dataset, summaries, level, evidence.budget, tints)
        if figure is not None:
            yield f"lambda-{dataset}", figure
    if evidence.across is not None:
        yield "interquartile-means", _middles(evidence, evidence.across)
        yield "performance-profiles", _profiles(evidence, evidence.across)
        yield "mean-ranks", _ranks(evidence, evidence.across)


def _curves(evidence: Evidence, dataset: str, cells: list[Cell], level: float) -> Figure:
    """Thesis figures 5.2 to 5.6: mean and deviation of the seeds over the training."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes, tints = figure.subplots(), colours(evidence.algorithms)
    levels, later = [], []
    for cell in cells:
        means = cell.returns[:, :, -1]  # [R, S]; of policies that take λ, at the last: 1
        x, mean = 100.0 * cell.steps / cell.steps[-1], means.mean(axis=0)
        spread = means.std(axis=0, ddof=1) if len(means) > 1 else np.zeros_like(mean)
        colour = tints[cell.algorithm]
        axes.plot(x, mean, color=colour, linewidth=1.6)
        axes.fill_between(x, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)
        levels.append((float(mean[-1]), cell.algorithm + (" λ=1" if cell.adapts else ""), colour))
        late = slice(len(mean) // 2, None)
        later += [*(mean - spread)[late].tolist(), *(mean + spread)[late].tolist()]
    axes.axhline(level, color=BEHAVIOUR_COLOUR, linestyle="--", linewidth=1.2)
    best = max((value for value, *_ in levels if math.isfinite(value)), default=math.nan)
    axes.set_ylim(limits([level, best], later))
    if not math.isnan(level):
        levels.append((level, "logged behaviour", BEHAVIOUR_COLOUR))
    name_levels(axes, levels)
    axes.set_xlim(0.0, 100.0)
    _label(axes, f"{dataset} ({evidence.budget})", "share of the updates (%)")
    axes.set_ylabel("discounted return\nmean ± deviation of the seeds")
    return figure


def _middles(evidence: Evidence, across: Across) -> Figure:
    figure = Figure(figsize=(6.4, 1.2 + 0.28 * len(across.columns)), layout="constrained")
    axes, tints = figure.subplots(), colours(evidence.algorithms)
    for number, (column, middle) in enumerate(zip(across.columns, across.middles, strict=True)):
        colour = tints[column.algorithm]
        axes.plot([middle.low, middle.high], [number, number], color=colour, linewidth=2)
        axes.plot(middle.value, number, "o", color=colour)
    _rows(axes, [column.heading for column in across.columns])
    _label(axes, f"Interquartile mean of scores ({evidence.budget})", "score")
    return figure


def _profiles(evidence: Evidence, across: Across) -> Figure:
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes, tints = figure.subplots(), colours(evidence.algorithms)
    styles = {"": "-", "0": ":", "best": "--", "1": "-"}
    for column, profile in zip(across.columns, across.profiles, strict=True):
        colour = tints[column.algorithm]
        style = styles[column.point]
        x = across.thresholds
        axes.plot(x, profile.value, style, color=colour, label=column.heading, linewidth=1.6)
        if style == "-":
            axes.fill_between(x, profile.low, profile.high, color=colour, alpha=0.12, linewidth=0)
    figure.legend(loc="outside right upper", fontsize="small", frameon=False)
    _label(axes, f"Performance profiles ({evidence.budget})", "score")
    axes.set_ylabel("share of runs above")
    return figure


def _ranks(evidence: Evidence, across: Across) -> Figure:
    figure = Figure(figsize=(6.4, 1.2 + 0.28 * len(across.columns)), layout="constrained")
    axes, tints = figure.subplots(), colours(evidence.algorithms)
    order = np.argsort(across.ranks.mean)
    for number, index in enumerate(order):
        column = across.columns[index]
        axes.plot(across.ranks.mean[index], number, "o", color=tints[column.algorithm])
    first = float(across.ranks.mean[order[0]])
    reach = first + across.ranks.critical_difference
    axes.axvspan(first, reach, color="0.92", zorder=0)
    _rows(axes, [across.columns[index].heading for index in order])
    title = f"Mean ranks; grey: not told apart from the best ({evidence.budget})"
    _label(axes, title, "mean rank (1 is best)")
    return figure


def _rows(axes: Axes, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.invert_yaxis()


def _label(axes: Axes, title: str, below: str) -> None:
    axes.set_title(title, fontsize="medium")
    axes.set_xlabel(below)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.5)
