"""The report of an import: what was read, what was done to it, what it holds; text and a figure."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset
from components.data.imports.importing import Imported

__all__ = ["FIGURE", "report_figure", "report_text"]

FIGURE: Final = "report.png"
"""Name of the figure that the text refers to."""
_TRACED: Final = 500  # rows drawn of the first episode
_DRAWN: Final = 24  # columns drawn at most
_COUNTED: Final = 200_000  # values of a histogram


def report_text(imported: Imported, sources: Sequence[str], command: str) -> str:
    """The report as Markdown.

    Args:
        imported: The log.
        sources: What its files are called.
        command: That imported it.
    """
    dataset = imported.dataset
    card = dataset.card
    lengths = np.diff(dataset.episode_starts)
    ended = int(dataset.terminated.sum())
    lines = [f"# The log {card.name}", "", f"Made by `{command}` of:", ""]
    lines += [f"- {source}" for source in sources[:20]]
    if len(sources) > 20:
        lines.append(f"- and {len(sources) - 20} more")
    lines += [
        "",
        f"{imported.rows} rows became {dataset.transitions} transitions in {dataset.episodes} "
        f"episodes of {lengths.min()} to {lengths.max()} steps (median {np.median(lengths):g}); "
        f"{ended} of them ended for good, {dataset.episodes - ended} were cut.",
        "",
        f"Discounted {card.return_steps}-step return from the start of an episode (discount "
        f"{card.discount:g}): mean {card.first_window_return_mean:.5g}, from "
        f"{card.first_window_return_min:.5g} to {card.first_window_return_max:.5g}; a policy sees "
        f"the last {card.history} rows.",
        "",
        "There is no real system to try policies on: a sweep over this dataset ends with the "
        "trained policies, which are not evaluated.",
        "",
        "## What looks wrong",
        "",
        *(_listed(imported.warnings) or ["Nothing."]),
        "",
        "## What was changed",
        "",
        *(_listed(imported.notes) or ["Nothing; every row is used."]),
        "",
        "## Columns",
        "",
        "| column | role | unit in the dataset | least | 5 % | median | 95 % | largest | sd |",
        "|---|---|---|--:|--:|--:|--:|--:|--:|",
    ]
    for name, values in zip(card.frame_features, dataset.frames.T, strict=True):
        lines.append(_row(name, "feature", "as in the log", values))
    for name, bounds, values in zip(
        card.action_features, card.action_bounds, dataset.actions.T, strict=True
    ):
        low, high = bounds
        unit = f"{low:g} ... {high:g} became -1 ... 1"
        lines.append(_row(name, "action", unit, low + (values + 1) / 2 * (high - low)))
    lines.append(_row("reward", "reward", "as in the log", dataset.rewards))
    lines += [
        "",
        "Numbers of actions are in the log's units.",
        "",
        f"![Course and distribution of the columns]({FIGURE})",
        "",
        f"SHA-256 of the arrays: `{card.digest}`",
        "",
    ]
    return "\n".join(lines)


def _listed(sentences: Sequence[str]) -> list[str]:
    return [f"- {sentence}" for sentence in sentences]


def _sampled(values: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(values[:: max(1, len(values) // _COUNTED)], np.float64)


def _row(name: str, role: str, unit: str, values: NDArray[np.floating]) -> str:
    parts = np.percentile(_sampled(values), (5, 50, 95))
    numbers = [values.min(), *parts, values.max(), _sampled(values).std()]
    shown = " | ".join(f"{number:.5g}" for number in numbers)
    return f"| {name.replace('|', '/')} | {role} | {unit} | {shown} |"


def report_figure(dataset: OfflineDataset) -> Figure:
    """Every column over the first episode, and its distribution over all of them."""
    card = dataset.card
    steps = min(int(dataset.episode_starts[1]), _TRACED)
    columns = [
        (name, values[: steps + 1], values)
        for name, values in zip(card.frame_features, dataset.frames.T, strict=True)
    ]
    columns += [
        (f"action {name}", values[:steps], values)
        for name, values in zip(card.action_features, dataset.actions.T, strict=True)
    ]
    columns.append(("reward", dataset.rewards[:steps], dataset.rewards))
    if len(columns) > _DRAWN:  # the last ones are the actions and the reward
        columns = [*columns[: _DRAWN // 2], *columns[-_DRAWN // 2 :]]
    figure = Figure(figsize=(8.0, 1.0 + 0.9 * len(columns)), layout="constrained")
    axes = figure.subplots(len(columns), 2, width_ratios=(3, 1), squeeze=False)
    for (course, counts), (name, first, values) in zip(axes, columns, strict=True):
        course.plot(first, linewidth=0.8)
        course.set_title(name.replace("$", r"\$"), fontsize="small", loc="left")
        counts.hist(_sampled(values), bins=40, linewidth=0)
        counts.set_yticks([])
        for part in (course, counts):
            part.tick_params(labelsize="x-small")
            part.spines[["top", "right"]].set_visible(False)
    axes[-1][0].set_xlabel("row of the first episode", fontsize="small")
    axes[-1][1].set_xlabel("all episodes", fontsize="small")
    return figure
