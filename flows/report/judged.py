"""Gathers what a report shows of policies that were judged from a log alone."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from components.aggregation.selection import scored
from components.data.card import DatasetCard
from components.reporting.judged import TRAINED_BY, Judged, JudgedLog, Returns, choices
from components.reporting.leads import leads_of
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import known_nodes
from flows.report.costs import cost_table, software_table
from flows.report.fits import fit_notes
from flows.report.graphs import graph_notes
from flows.report.leads import expected_frames
from flows.report.other_tables import guesses_of
from flows.report.selection import doubts, judged_policies
from flows.report.software import software_notes
from flows.report.stored_nodes import read_stored_sweep

__all__ = ["gather_judged", "has_judgements", "judged_alone", "judged_logs", "judged_table"]

_CARD = "dataset/card.json"
_TRIED, _JUDGED = "aggregate/", "judge/"


def has_judgements(root: Path, name: str) -> bool:
    """Whether policies of a sweep are judged, finished or not."""
    return any(run.startswith(_JUDGED) for run in known_nodes(root, name).values())


def gather_judged(store: ArtifactStore, names: Sequence[str]) -> Judged:
    """Read everything that a report on judged policies shows.

    Args:
        store: With the sweeps.
        names: Of the sweeps; of several, labels of logs and algorithms name theirs.

    Raises:
        SettingsError: There is no such sweep.
        DamagedFileError: A file behind the report is missing or damaged.
    """
    several = len(names) > 1
    sweeps = {name: read_stored_sweep(store, name) for name in names}
    logs, tables, notes, said = [], [], [], []
    for name, sweep in sweeps.items():
        suffix = f" · {name}" if several else ""
        policies = judged_table(store, sweep.done)
        logs += judged_logs(store, sweep.done, sweep.missing, policies, suffix)
        tables.append(policies.assign(sweep=name) if several else policies)
        notes += [
            *fit_notes(sweep.done, store),
            *software_notes(sweep.of("judgement"), store),
            *graph_notes(sweep.done, store),
        ]
        said.append(sweep.budget([policies["seed"].nunique()] if len(policies) else []))
    done = list({node.key: node for sweep in sweeps.values() for node in sweep.done}.values())
    return Judged(
        sweeps={name: sweep.repeatable for name, sweep in sweeps.items()},
        logs=logs,
        policies=pd.concat(tables, ignore_index=True),
        notes=list(dict.fromkeys(notes)),
        costs=cost_table({f" · {n}" if several else "": sweep.done for n, sweep in sweeps.items()}),
        software=software_table(done),
        budget="; ".join(dict.fromkeys(said)),
    )


def judged_alone(done: Sequence[Node], missing: Sequence[str]) -> list[str]:
    """Datasets whose policies are judged and cannot be tried, finished or not.

    Args:
        done: The finished nodes of a sweep.
        missing: Run names of the others.
    """
    runs = [*(node.name for node in done), *missing]
    tried, judged = (
        dict.fromkeys(run.split("/")[2] for run in runs if run.startswith(kind))
        for kind in (_TRIED, _JUDGED)
    )
    return [dataset for dataset in judged if dataset not in tried]


def judged_logs(
    store: ArtifactStore,
    done: Sequence[Node],
    missing: Sequence[str],
    policies: pd.DataFrame,
    suffix: str = "",
) -> list[JudgedLog]:
    """What was judged of a sweep's logs without a real system, log by log.

    Args:
        store: With the sweep.
        done: Its finished nodes.
        missing: Run names of the others.
        policies: Its judged policies.
        suffix: Of the labels.

    Raises:
        DamagedFileError: A file behind it is missing or damaged.
    """
    cards, keys = {}, {}
    for node in _of(done, "data_generation"):
        store.check(node.key, (_CARD,))
        keys[node.tags["dataset"]] = node.key
        cards[node.tags["dataset"]] = DatasetCard.load(store.path(node.key) / _CARD)
    guesses = guesses_of(store.root, keys)
    frames = expected_frames(done, store)
    logs = []
    for dataset in judged_alone(done, missing):
        own = policies[policies["dataset"] == dataset] if len(policies) else policies
        labelled = own.assign(algorithm=own["algorithm"] + suffix) if len(own) else own
        card = cards.get(dataset)
        leads = frames
        if len(frames):
            leads = frames[frames["dataset"] == dataset]
            leads = leads.assign(algorithm=leads["algorithm"] + suffix)
        logs.append(
            JudgedLog(
                name=dataset + suffix,
                dataset=dataset,
                choices=choices(labelled, leads_of(leads)) if len(own) else [],
                returns=None if card is None else _returns(card),
                facts={} if card is None else _facts(card, _held_out(done, dataset)),
                doubts=doubts(own, [card]) if card is not None and len(own) else [],
                progress=_progress(done, missing, dataset),
                guess=guesses.get(dataset),
            )
        )
    return logs


def judged_table(store: ArtifactStore, done: Sequence[Node]) -> pd.DataFrame:
    """All judged policies of a sweep with their scores, and what trained them.

    Returns:
        A row per policy, snapshot and proximity: what the judgement found, scores, and of the
        training its digest (`policy`), `run`, `hardware` and `commit` (empty if unknown).

    Raises:
        DamagedFileError: A judgement is missing or damaged.
    """
    found = judged_policies(done, store)
    if found.empty:
        return found
    runs = {node.key: node.name for node in _of(done, "policy_training")}
    records = {key: store.record(key) for key in found["policy"].unique()}
    origin = {
        part: found["policy"].map({key: str(of.get(part, "")) for key, of in records.items()})
        for part in TRAINED_BY[1:]
    }
    return scored(found.assign(run=found["policy"].map(runs), **origin))


def _returns(card: DatasetCard) -> Returns:
    return Returns(
        card.first_window_return_mean, card.first_window_return_min, card.first_window_return_max
    )


def _of(done: Sequence[Node], component: str) -> list[Node]:
    return [node for node in done if node.component == component]


def _held_out(done: Sequence[Node], dataset: str) -> float | None:
    """Share of the episodes that the judges keep for themselves."""
    for node in _of(done, "data_split"):
        if node.tags["dataset"] == dataset:
            return float(node.config["held_out"])
    return None


def _facts(card: DatasetCard, held_out: float | None) -> dict[str, str]:
    """The card in words, by heading."""
    bounds = card.action_bounds or ((-1.0, 1.0),) * len(card.action_features)
    actions = [
        f"{name} ({low:g} to {high:g})"
        for name, (low, high) in zip(card.action_features, bounds, strict=True)
    ]
    facts = {
        "episodes": f"{card.trajectories:,}, the longest of {card.steps:,} steps",
        "steps": f"{card.transitions:,}",
        "logged by": card.controller or "unknown",
        "return": f"discounted by {card.discount:g} a step, over the first {card.return_steps} "
        f"steps of an episode: mean {card.first_window_return_mean:,.6g}, from "
        f"{card.first_window_return_min:,.6g} to {card.first_window_return_max:,.6g}",
        "columns of the state": ", ".join(card.frame_features),
        "actions": ", ".join(actions),
        "what a policy sees": f"the newest {card.history} rows",
    }
    if card.sampling:
        facts["interval of the rows"] = f"{card.sampling:g} (seconds, or the log's unit of time)"
    if held_out is not None:
        facts["kept for the judges"] = f"the last {held_out:.0%} of the episodes"
    return facts


def _progress(done: Sequence[Node], missing: Sequence[str], dataset: str) -> list[str]:
    """A sentence on what is not judged yet, if anything is."""

    def counted(runs: Sequence[str], kind: str) -> Counter[str]:
        begin = [run.removeprefix(kind).split("/") for run in runs if run.startswith(kind)]
        return Counter(parts[0] for parts in begin if len(parts) == 3 and parts[1] == dataset)

    names = [node.name for node in done]
    waiting, judged = counted(missing, _JUDGED), counted(names, _JUDGED)
    if not waiting:
        return []
    trained = counted([node.name for node in _of(done, "policy_training")], "")
    said = [
        f"{algorithm}: {judged[algorithm]} of {judged[algorithm] + count} seeds judged, "
        f"{trained[algorithm]} trained"
        for algorithm, count in waiting.items()
    ]
    return [f"Not finished: {'; '.join(said)}."]
