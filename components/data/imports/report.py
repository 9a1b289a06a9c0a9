"""The report of an import: what was read, what was done to it, what it holds; text and a figure."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset
from components.data.imports.importing import Imported
from components.environments.systems import SYSTEMS

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
        _after_training(card.environment),
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
    limits = card.action_bounds or ((-1.0, 1.0),) * len(card.action_features)
    for name, (low, high), values in zip(
        card.action_features, limits, dataset.actions.T, strict=True
    ):
        unit = f"{low:g} ... {high:g} became -1 ... 1" if card.action_bounds else "-1 ... 1"
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


def _after_training(environment: str) -> str:
    """What happens to policies that are trained on the log."""
    if environment in SYSTEMS:
        return f"Policies trained on it are evaluated on {environment}, which its card names."
    return (
        "There is no real system to try policies on: a sweep over this dataset judges the "
        "trained policies from a part of the log that they have not learned from."
    )


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
    height = 0.6 + len(columns)  # inches; placed by hand, which is three times as fast
    figure = Figure(figsize=(8.0, height))
    axes = figure.subplots(len(columns), 2, width_ratios=(3, 1), squeeze=False)
    figure.subplots_adjust(
        left=0.08, right=0.98, bottom=0.45 / height, top=1 - 0.25 / height, hspace=0.7, wspace=0.1
    )
    for (course, counts), (name, first, values) in zip(axes, columns, strict=True):
        course.plot(first, linewidth=0.8)
        course.set_title(name.replace("$", r"\$"), fontsize="small", loc="left")
        counts.stairs(*np.histogram(_sampled(values), bins=40), fill=True)
        counts.set_yticks([])
        for part in (course, counts):
            part.tick_params(labelsize="x-small")
            part.spines[["top", "right"]].set_visible(False)
    axes[-1][0].set_xlabel("row of the first episode", fontsize="small")
    axes[-1][1].set_xlabel("all episodes", fontsize="small")
    return figure
