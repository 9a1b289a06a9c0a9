"""Figures of a ranking of datasets: thesis figure 4.2, and what EAS's clip decides."""

import math
from collections.abc import Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from components.reporting.ranking import Measured

__all__ = ["clip_figure", "ranking_figure"]


def ranking_figure(logs: Sequence[Measured], algorithm: str | None) -> Figure:
    """ERI over the true improvement, EAS over the true share of random actions (figure 4.2).

    Args:
        logs: Of one ranking.
        algorithm: Whose true improvement is shown. None: there is none, and ERI is drawn over EAS.
    """
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    eri, eas = [log.eri for log in logs], [log.eas for log in logs]
    names = [log.name for log in logs]
    if algorithm is None:
        _scatter(left, names, eas, eri)
        left.set_xlabel("estimated action stochasticity (EAS)")
    else:
        _scatter(left, names, [log.improvement(algorithm) for log in logs], eri)
        left.set_xlabel(f"true return improvement (TRI) by {algorithm}")
        left.set_xscale("symlog", linthresh=0.01)  # a bad controller can be improved a hundredfold
    if min(eri) > 0:
        left.set_yscale("log")
    left.set_ylabel("expected return improvement (ERI)")
    truth = [log.facts.epsilon if log.generated else math.nan for log in logs]
    if any(not math.isnan(value) for value in truth):
        _scatter(right, names, truth, eas)
        right.set_xlabel("share of random actions in the log")
    else:
        _scatter(right, names, [min(log.facts.action_range) for log in logs], eas)
        right.set_xlabel("range of the narrowest action, share of its bounds")
    right.set_ylabel("estimated action stochasticity (EAS)")
    return figure


def clip_figure(logs: Sequence[Measured], table: pd.DataFrame, clip: float) -> Figure:
    """EAS of every log over the clip, and how far the clip keeps the order of the logs.

    Args:
        logs: Of one ranking.
        table: As :func:`~components.reporting.ranking.clip_table` has made it.
        clip: The one that is used.
    """
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    x = [-math.log10(1.0 - value) for value in table["clip"]]
    for number, log in enumerate(logs):
        style = ("-", "--", ":")[number // 10 % 3]
        upper.plot(x, table[log.name], style, color=f"C{number % 10}", linewidth=1.4)
        upper.annotate(
            log.name, (x[-1], table[log.name].iloc[-1]), xytext=(4, 0), fontsize="x-small",
            textcoords="offset points", va="center",
        )  # fmt: skip
    upper.set_ylabel("estimated action stochasticity (EAS)")
    lower.plot(x, table["spearman_chosen"], "o-", color="0.4", label=f"with the order at {clip:g}")
    if table["spearman_thesis"].notna().any():
        lower.plot(x, table["spearman_thesis"], "o-", color="C0", label="with thesis table 4.1")
    lower.set_ylabel("Spearman")
    lower.legend(fontsize="small", edgecolor="none")
    lower.set_xticks(x, [f"{value:g}" for value in table["clip"]])
    lower.set_xlabel("clip of logged actions before the inverse tanh")
    for axes in (upper, lower):
        axes.axvline(-math.log10(1.0 - clip), color="0.7", linestyle=":", linewidth=1.2)
        _plain(axes)
    return figure


def _scatter(axes: Axes, names: Sequence[str], x: Sequence[float], y: Sequence[float]) -> None:
    """Points with their names; those without a value are left out."""
    shown = [
        (name, across, up)
        for name, across, up in zip(names, x, y, strict=True)
        if math.isfinite(across) and math.isfinite(up)
    ]
    for name, across, up in shown:
        axes.plot(across, up, "o", color="C0", markersize=4)
        axes.annotate(
            name, (across, up), xytext=(4, 3), textcoords="offset points", fontsize="x-small"
        )
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.5)
