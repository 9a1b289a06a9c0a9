"""The report of a sweep: table and figures of everything that is finished."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from components.core.files import write_text
from components.data.card import DatasetCard
from components.environments.rendering import DRAWABLE
from components.reporting.figures import proximity_figure, save_figure
from components.reporting.overview import Overview, overview
from components.reporting.overview_text import markdown_overview, text_table
from components.reporting.promises import brief
from components.reporting.stored import ReportNodes
from components.reporting.tables import (
    ended_notes,
    markdown_table,
    result_table,
    results_csv,
    undefined_notes,
    with_undefined,
)
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.judging import LEAST_EPISODES
from flows.report.comparison import comparable_behaviour, compare
from flows.report.films import film_notes
from flows.report.fits import fit_notes
from flows.report.graphs import graph_notes
from flows.report.judged import judged_logs, judged_table
from flows.report.returns import cell_returns, with_intervals
from flows.report.selection import NOTHING_JUDGED, Selection, write_selection
from flows.report.shown import Shown
from flows.report.software import software_notes

__all__ = ["Report", "write_report"]

_CARD = "dataset/card.json"


@dataclass(frozen=True)
class Report:
    """What was written.

    Attributes:
        files: The table as CSV and as Markdown, figures.
        table: One row per dataset, algorithm and proximity.
        overview: One row per dataset, one column per algorithm.
        summaries: The stored summaries behind the rows.
        untried: Datasets whose policies cannot be evaluated, and what becomes of these.
        fit_notes: Sentences about models whose fit ended early.
        software: A sentence if rows come from different software or devices.
        graphs: Sentences about trainings that have lost their CUDA graphs.
        comparison: Sentences about what cannot be compared with the thesis.
        selection: Policies that were judged from their log.
        first: What to try first on logs without a system, in lines.
        nodes: The file with the keys of the nodes behind it.
    """

    files: Sequence[Path]
    table: pd.DataFrame
    overview: Overview
    summaries: Sequence[Mapping[str, Any]]
    untried: Mapping[str, str]
    fit_notes: Sequence[str] = ()
    software: Sequence[str] = ()
    graphs: Sequence[str] = ()
    comparison: Sequence[str] = ()
    selection: Selection = NOTHING_JUDGED
    first: Sequence[str] = ()
    nodes: Path | None = None

    @property
    def notes(self) -> list[str]:
        """Sentences about what the table does not show."""
        return [
            *self.comparison,
            *self.fit_notes,
            *ended_notes(self.summaries),
            *undefined_notes(self.summaries),
            *(
                f"{name} has no system to evaluate on: its policies are {said}"
                for name, said in self.untried.items()
            ),
            *self.software,
            *self.graphs,
        ]

    @property
    def headline(self) -> dict[str, list[tuple[int, float]]]:
        """10th percentile per dataset and algorithm, at the best proximity where there are several.

        All of these stand under another name, with the step 100 times the proximity: MLflow lists
        a curve by its last point.
        """
        shown: dict[str, list[tuple[int, float]]] = {}
        for summary in self.summaries:
            cell = f"{summary['dataset']}/{summary['algorithm']}"
            curve = [
                (round(100 * (point["lambda"] or 0.0)), point["tenth_percentile"])
                for point in summary["points"]
            ]
            best = max(curve, key=lambda point: -math.inf if math.isnan(point[1]) else point[1])
            shown[f"tenth_percentile/{cell}"] = [(0, best[1])]
            if len(curve) > 1:
                shown[f"over_proximity/{cell}"] = curve
        return shown

    @property
    def shown(self) -> Shown:
        """What to print and to record: the overview, if it has rows, and notes on it."""
        table, signs = None, []
        if not self.table.empty:
            table, signs = text_table(self.overview), ["", *self.overview.notes()]
        judged = [*self.selection.lines, *self.first]
        below = [*signs, *judged, *(f"Note: {note}" for note in self.notes)]
        return Shown(self.files, table, below, self.headline)

    def lines(self, width: int) -> list[str]:
        """What to print in a window of `width` characters."""
        return self.shown.lines(width)

    def markdown(self) -> str:
        """The overview, what its signs mean, and the long form, as Markdown, if there are rows."""
        if self.table.empty:
            return ""
        signs = "".join(f"\n{note}\n" for note in self.overview.notes())
        return f"{markdown_overview(self.overview)}{signs}\n{markdown_table(self.table)}"


def write_report(folder: Path, plan: Plan, store: ArtifactStore, about: str = "") -> Report:
    """Write table and figures of everything that is finished.

    Args:
        folder: Made if needed.
        plan: Of the sweep.
        store: With its artifacts.
        about: Profile and seeds, for the titles of figures.

    Raises:
        DamagedFileError: A file that the report is made of is missing or damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    done = [node for node in plan if store.complete(node.key)]
    aggregations = [node for node in done if node.component == "aggregation"]
    generations = [node for node in done if node.component == "data_generation"]
    summaries = [_summary(node, store) for node in aggregations]
    for node in generations:
        store.check(node.key, (_CARD,))
    cards = [DatasetCard.load(store.path(node.key) / _CARD) for node in generations]
    comparison = compare(aggregations)
    table = result_table(summaries, comparison.thesis)
    logged = {card.name: comparable_behaviour(card, aggregations) for card in cards}
    files = [folder / "results.csv", folder / "results.md"]
    files += _write_figures(folder, logged, _drawn(aggregations, summaries), about)
    selection = write_selection(folder, done, store, cards)
    report = Report(
        [*files, *selection.files],
        table,
        overview(table, logged, comparison.thesis, comparison.footnotes),
        summaries,
        _untried(plan, done, cards),
        fit_notes(done, store),
        software_notes(aggregations, store),
        graph_notes(done, store),
        comparison.notes,
        selection,
        _first(plan, done, store) if selection.datasets else [],
    )
    drawable = [card.name for card in cards if card.environment in DRAWABLE]
    notes = [*report.notes, *film_notes(done, drawable)]
    judged = "".join(f"{line}\n" for line in (*selection.lines, *report.first))
    said = "".join(f"\n- {note}" for note in notes) + "\n" * bool(notes)
    text = report.markdown() + judged + said
    datasets = {card.name: node.key for card, node in zip(cards, generations, strict=True)}
    nodes = ReportNodes(tuple(node.key for node in aggregations), datasets).save(folder)
    write_text(folder / "results.csv", results_csv(table))
    write_text(folder / "results.md", text)
    return replace(report, nodes=nodes)


def _summary(cell: Node, store: ArtifactStore) -> dict[str, Any]:
    stored = with_undefined(store.read_json(cell.key, "summary.json"))
    return with_intervals(stored, cell_returns(cell, store), cell.config["pool_fraction"])


def _first(plan: Plan, done: Sequence[Node], store: ArtifactStore) -> list[str]:
    """What to try first on every log whose policies are judged and cannot be tried."""
    finished = {node.key for node in done}
    missing = [node.name for node in plan if node.key not in finished]
    logs = judged_logs(store, done, missing, judged_table(store, done))
    return [line for log in logs if log.choices for line in ("", *brief(log))]


def _untried(plan: Plan, done: Sequence[Node], cards: Sequence[DatasetCard]) -> dict[str, str]:
    """Datasets of the plan with policies and no evaluation, and what becomes of their policies."""

    def counted(nodes: Iterable[Node], component: str) -> Counter[str]:
        return Counter(node.tags["dataset"] for node in nodes if node.component == component)

    trained, evaluated = counted(plan, "policy_training"), counted(plan, "evaluation")
    wanted, judged = counted(plan, "judgement"), counted(done, "judgement")
    episodes = {card.name: card.trajectories for card in cards}
    found = {}
    for name in sorted(trained.keys() - evaluated.keys()):
        if wanted[name] and judged[name] == wanted[name]:
            found[name] = "judged from its log alone."
        elif wanted[name]:
            found[name] = (
                f"judged from its log alone, {judged[name]} of {wanted[name]} so far; the same "
                "command again continues."
            )
        elif episodes.get(name, LEAST_EPISODES) < LEAST_EPISODES:
            found[name] = (
                f"stored but not evaluated; a judgement from the log takes {LEAST_EPISODES} "
                f"episodes, and it has {episodes[name]}."
            )
        else:
            why = ", since judging.policies=none" if name in episodes else ""
            found[name] = f"stored but neither evaluated nor judged{why}."
    return found


def _drawn(
    aggregations: Sequence[Node], summaries: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """The summaries that figures show.

    Variants of one algorithm are in the table only: dozens of lines would hide the others.
    """
    return [
        summary
        for node, summary in zip(aggregations, summaries, strict=True)
        if summary["algorithm"] in node.tags.values()
    ]


def _write_figures(
    folder: Path,
    logged: Mapping[str, float | None],
    drawn: Sequence[dict[str, Any]],
    about: str,
) -> list[Path]:
    files = []
    for name, level in logged.items():
        own = [summary for summary in drawn if summary["dataset"] == name]
        figure = proximity_figure(name, own, math.nan if level is None else level, about)
        if figure is not None:
            files.append(folder / f"{name}.png")
            save_figure(figure, files[-1])
    return files
