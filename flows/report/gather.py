"""Gathers what a report shows from a store: one sweep, or several beside each other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from components.aggregation.statistics import pooled_snapshots
from components.data.card import DatasetCard
from components.reporting.evidence import Cell, Evidence, Gap, Log
from components.reporting.judged import JudgedLog
from components.reporting.overview import Column, Overview, overview
from components.reporting.tables import (
    ended_notes,
    result_table,
    undefined_notes,
    with_undefined,
)
from flows.configuration.checking import SettingsError
from flows.pipeline.store import ArtifactStore
from flows.report.across import compare_across
from flows.report.comparison import Comparison, comparable_behaviour, compare
from flows.report.costs import cost_table, software_table
from flows.report.fits import fit_notes
from flows.report.graphs import graph_notes
from flows.report.judged import judged_alone, judged_logs, judged_table
from flows.report.other_tables import judges_of, ranking_of, selection_of
from flows.report.returns import cell_returns, with_intervals
from flows.report.software import software_notes
from flows.report.stored_nodes import StoredNode, StoredSweep, has_cells, read_stored_sweep

__all__ = ["gather"]

_CARD = "dataset/card.json"


@dataclass(frozen=True)
class _Part:
    """One sweep of a report; the suffix of its labels is empty where it is alone."""

    suffix: str
    sweep: StoredSweep
    comparison: Comparison
    logs: Mapping[str, Log]
    cells: Sequence[Cell]
    summaries: Sequence[Mapping[str, Any]]
    gaps: Sequence[Gap]
    judged: Sequence[JudgedLog]
    judged_policies: pd.DataFrame


def gather(store: ArtifactStore, names: Sequence[str]) -> Evidence:
    """Read everything that a report shows.

    Args:
        store: With the sweeps.
        names: Of the sweeps; of several, labels of algorithms name theirs.

    Raises:
        SettingsError: There is no such sweep, or no result of one is finished yet and no policy is
            judged from its log alone.
        DamagedFileError: A file behind the report is missing or damaged.
    """
    parts = [_read(store, name, several=len(names) > 1) for name in names]
    if not any(part.cells or part.judged for part in parts):
        if not any(has_cells(store.root, name) for name in names):
            raise SettingsError(
                f"sweep={','.join(names)} has neither evaluated nor judged policies, and the page "
                f"is about those; {store.root / 'reports' / names[0]} holds what it has found."
            )
        raise SettingsError(
            f"sweep={','.join(names)}: no dataset and algorithm is finished with all seeds yet; "
            "give the sweep's own command to go on."
        )
    logs: dict[str, Log] = {}
    for name, log in (item for part in parts for item in part.logs.items()):
        if name not in logs or logs[name].level is None:
            logs[name] = log
    thesis = {
        (cell.dataset, cell.algorithm): value
        for part in parts
        for cell in part.cells
        if (value := part.comparison.thesis.get((cell.dataset, cell.base))) is not None
    }
    footnotes: dict[str, str] = {}
    for mark, text in (f for part in parts for f in part.comparison.footnotes.items()):
        if text not in footnotes.setdefault(mark, text):
            footnotes[mark] += f" And {text}"
    table = result_table((s for part in parts for s in part.summaries), thesis)
    gaps = [gap for part in parts for gap in part.gaps]
    logged = {name: log.level for name, log in logs.items()}
    levels = {(c.dataset, c.algorithm): c.level for part in parts for c in part.cells}
    rows = _with_gaps(overview(table, logged, thesis, footnotes, levels), gaps, logged)
    cells = {(c.dataset, c.algorithm): c for part in parts for c in part.cells}
    unknown = {name: Log(name, "", None, None, "not generated yet") for name in rows.logged}
    shown = {name: logs.get(name, unknown[name]) for name in rows.logged}
    done = list({node.key: node for part in parts for node in part.sweep.done}.values())
    aggregations = [node for part in parts for node in part.sweep.of("aggregation")]
    notes = [note for part in parts for note in part.comparison.notes]
    data = {n.tags["dataset"]: n.key for part in parts for n in part.sweep.of("data_generation")}
    return Evidence(
        sweeps={part.sweep.name: part.sweep.repeatable for part in parts},
        logs=shown,
        cells=cells,
        gaps=gaps,
        table=rows,
        thesis=thesis,
        notes=[
            *dict.fromkeys(notes),
            *fit_notes(done, store),
            *(n for part in parts for n in ended_notes(part.summaries)),
            *(n for part in parts for n in undefined_notes(part.summaries)),
            *software_notes(aggregations, store),
            *graph_notes(done, store),
        ],
        differences=_differences(parts),
        costs=cost_table({part.suffix: part.sweep.done for part in parts}),
        software=software_table(done),
        ranking=ranking_of(store.root, data),
        selection=selection_of(store.root, names),
        judges=judges_of(store.root, names),
        judged=[log for part in parts for log in part.judged],
        judged_policies=pd.concat([part.judged_policies for part in parts], ignore_index=True),
        across=compare_across(rows, cells, shown),
        budget="; ".join(
            dict.fromkeys(p.sweep.budget(len(cell.seeds) for cell in p.cells) for p in parts)
        ),
    )


def _read(store: ArtifactStore, name: str, *, several: bool) -> _Part:
    sweep = read_stored_sweep(store, name)
    suffix = f" · {name}" if several else ""
    aggregations = sweep.of("aggregation")
    logs = {}
    alone = judged_alone(sweep.done, sweep.missing)
    for node in sweep.of("data_generation"):
        if node.tags["dataset"] in alone:
            continue  # nothing can be tried there: such logs have a part of their own
        store.check(node.key, (_CARD,))
        card = DatasetCard.load(store.path(node.key) / _CARD)
        logs[card.name] = _log(card, comparable_behaviour(card, aggregations))
    cells, summaries = [], []
    for node in aggregations:
        seeds, fraction = cell_returns(node, store), node.config["pool_fraction"]
        stored = with_undefined(store.read_json(node.key, "summary.json"))
        summary = with_intervals(stored, seeds, fraction)
        summary["algorithm"] += suffix
        cells.append(
            Cell(
                dataset=summary["dataset"],
                algorithm=summary["algorithm"],
                base=node.config["algorithm"],
                seeds=summary["seeds"],
                steps=seeds[0].steps,
                proximities=seeds[0].proximities,
                returns=np.stack([seed.returns for seed in seeds]),
                pooled=pooled_snapshots(len(seeds[0].returns), fraction),
                points=summary["points"],
                level=logs[summary["dataset"]].level,
                configurations=[run.key for run in _training(node)],
                hardware=[str(run.record.get("hardware", "")) for run in _training(node)],
                commits=[str(run.record.get("commit", "")) for run in _training(node)],
            )
        )
        summaries.append(summary)
    comparison = compare(aggregations)
    judged, policies = [], pd.DataFrame()
    if alone:
        policies = judged_table(store, sweep.done)
        judged = judged_logs(store, sweep.done, sweep.missing, policies, suffix)
        if len(policies):
            policies = policies[policies["dataset"].isin(alone)]
            policies = policies.assign(sweep=name) if several else policies
    gaps = _gaps(sweep, suffix)
    return _Part(suffix, sweep, comparison, logs, cells, summaries, gaps, judged, policies)


def _training(aggregation: StoredNode) -> list[StoredNode]:
    """The runs that trained the policies behind a result, in the order of their seeds."""
    return [evaluation.inputs["policy"] for evaluation in aggregation.inputs.values()]


def _log(card: DatasetCard, level: float | None) -> Log:
    best = None if level is None else card.first_window_return_max
    about = f"{card.trajectories:,} episodes, {card.transitions:,} steps"
    if card.controller:
        about += f", logged by {card.controller}"
    if card.epsilon:
        about += f" with {card.epsilon:.0%} random actions"
    return Log(card.name, card.environment, level, best, about)


def _gaps(sweep: StoredSweep, suffix: str) -> list[Gap]:
    """Pairs without a result, and how far they are."""
    gaps = []
    names = [node.name for node in sweep.done]
    for missing in sweep.missing:
        kind, _, pair = missing.partition("/")
        if kind == "aggregate":
            label, _, dataset = pair.rpartition("/")
            begin = f"evaluate/{pair}/"
            done = sum(name.startswith(begin) for name in names)
            wanted = done + sum(name.startswith(begin) for name in sweep.missing)
            gaps.append(Gap(dataset, label + suffix, f"{done} of {wanted} seeds evaluated"))
    return gaps


def _with_gaps(
    table: Overview, gaps: Sequence[Gap], levels: Mapping[str, float | None]
) -> Overview:
    """The overview with rows and columns of what is not finished anywhere, too."""
    known = {column.algorithm for column in table.columns}
    names = dict.fromkeys(gap.algorithm for gap in gaps if gap.algorithm not in known)
    logged = dict(table.logged)
    for gap in gaps:
        logged.setdefault(gap.dataset, levels.get(gap.dataset))
    return replace(table, columns=[*table.columns, *map(Column, names)], logged=logged)


def _differences(parts: Sequence[_Part]) -> pd.DataFrame:
    """Settings that are not the profile "paper"'s, and on how many datasets."""
    found: dict[tuple[str, ...], set[str]] = {}
    for part in parts:
        for (dataset, _), own in part.comparison.differences.items():
            for d in own:
                row = (part.sweep.name, d.part, d.setting, str(d.here), str(d.thesis))
                found.setdefault(row, set()).add(dataset)
    rows = [(*row, len(datasets)) for row, datasets in found.items()]
    columns = ["sweep", "part", "setting", "here", "paper profile", "datasets"]
    table = pd.DataFrame(rows, columns=columns)
    return table if len(parts) > 1 else table.drop(columns="sweep")
