"""Orphans: what lies in a store and belongs to nothing in it.

    work        begun and not finished, of no recorded sweep or untouched for long
    artifact    finished, but of no sweep, report, run or event, and read by nothing that is
    run         in MLflow, but its artifact is gone and no recorded sweep will make it again
    row         of the leaderboard in MLflow, about an artifact of which the same is true
    leftover    temporary files of killed writers, damaged artifacts set aside, files without a run

An artifact and the files of its MLflow run are second names of the same files, so removing one of
them frees nothing: sizes count what removing all orphans together gives back.
"""

import os
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from components.reporting.stored import ReportNodes
from flows.pipeline.json_lines import read_lines
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord

__all__ = ["Orphan", "RecordedRow", "RecordedRun", "find_orphans", "freed_bytes"]

_DAY = 86400.0
_MODELS = "models"  # where MLflow keeps the models that flows.export_policy records


@dataclass(frozen=True)
class RecordedRun:
    """The run of a node in MLflow.

    Attributes:
        id: Of the run.
        key: Of the node; empty for the run of a sweep or trial.
        name: Of the run.
        finished: Whether it is the run of a finished node, and not deleted.
    """

    id: str
    key: str
    name: str
    finished: bool


@dataclass(frozen=True)
class RecordedRow:
    """A row of the leaderboard in MLflow.

    Attributes:
        id: Of its run.
        name: Of its run.
        keys: Of the nodes behind it.
    """

    id: str
    name: str
    keys: frozenset[str]


@dataclass(frozen=True)
class Orphan:
    """Something that belongs to nothing.

    Attributes:
        kind: "work", "artifact", "run", "row" or "leftover".
        what: One line for people.
        paths: The files and folders to remove.
        keys: The nodes whose locks must be held meanwhile.
        run: Id of the run to delete, which a row has, too; empty if there is none.
    """

    kind: str
    what: str
    paths: tuple[Path, ...] = ()
    keys: frozenset[str] = frozenset()
    run: str = ""


def find_orphans(
    store: ArtifactStore,
    sweeps: Sequence[SweepRecord],
    runs: Sequence[RecordedRun] | None,
    days: float,
    rows: Sequence[RecordedRow] = (),
) -> list[Orphan]:
    """All orphans of a store, by kind.

    Args:
        store: The store.
        sweeps: Its recorded sweeps.
        runs: All runs in its MLflow database, of whatever kind; None if there is none here.
        days: Work that nobody has touched for so long is an orphan, whichever sweep began it.
        rows: Of the leaderboard in the same database.

    Raises:
        ValueError: A report's or a tracker's file is damaged: it is not known what is needed.
    """
    names: dict[str, str] = {}
    for sweep in sweeps:
        names |= sweep.nodes
    used = _used(store, names, runs or ())
    return [
        *_work(store, names, days),
        *_artifacts(store, used),
        *_runs(store, names, runs or ()),
        *_rows(store, names, rows),
        *_leftovers(store, runs),
    ]


def _used(store: ArtifactStore, names: Mapping[str, str], runs: Iterable[RecordedRun]) -> set[str]:
    """Keys that something names, and of all that these were made from."""
    open_keys = set(names) | {run.key for run in runs if run.key}
    for report in store.root.glob("reports/*/report.json"):
        nodes = ReportNodes.load(report.parent)
        open_keys |= {*nodes.aggregations, *nodes.datasets.values()}
    for file in store.root.glob("tracking/*.jsonl"):
        for event in read_lines(file):
            node = event.get("node")
            open_keys |= {str(event.get("about")), str(node["key"]) if node else ""}
    inputs = {r["key"]: set(r.get("inputs", {}).values()) for r in store.records() if "key" in r}
    used: set[str] = set()
    while open_keys:
        key = open_keys.pop()
        used.add(key)
        open_keys |= inputs.get(key, set()) - used
    return used


def _work(store: ArtifactStore, names: Mapping[str, str], days: float) -> Iterator[Orphan]:
    for work in store.work_folders():
        unfinished = store.unfinished(work)
        known = sorted(names[key] for key in unfinished & names.keys())
        idle = (time.time() - _newest(work.path)) / _DAY
        if known and idle < days:
            continue
        title = known[0] if known else f"node {min(work.serves)}"
        more = f" and {len(work.serves) - 1} more" if len(work.serves) > 1 else ""
        why = f"untouched for {idle:.0f} days" if known else "in no recorded sweep"
        yield Orphan("work", f"{title}{more}: {why}", (work.path,), work.serves)


def _artifacts(store: ArtifactStore, used: Collection[str]) -> Iterator[Orphan]:
    for record in store.records():
        key = str(record.get("key"))
        if key not in used and store.path(key).is_dir():
            name = record.get("name", "?")
            what = f"{name}: in no recorded sweep, report or run"
            yield Orphan("artifact", what, (store.path(key),), frozenset({key}))


def _runs(
    store: ArtifactStore, names: Mapping[str, str], runs: Iterable[RecordedRun]
) -> Iterator[Orphan]:
    for run in runs:
        if run.finished and run.key and _is_gone(store, names, run.key):
            files = store.root / "artifacts" / run.id
            what = f"{run.name}: run {run.id}, whose artifact {run.key} is gone"
            yield Orphan("run", what, (files,) if files.is_dir() else (), run=run.id)


def _rows(
    store: ArtifactStore, names: Mapping[str, str], rows: Iterable[RecordedRow]
) -> Iterator[Orphan]:
    for row in rows:
        gone = sorted(key for key in row.keys if _is_gone(store, names, key))
        if gone:
            what = f"{row.name}: row {row.id} of the leaderboard, whose artifact {gone[0]} is gone"
            yield Orphan("row", what, run=row.id)


def _is_gone(store: ArtifactStore, names: Mapping[str, str], key: str) -> bool:
    """Whether an artifact is gone and no recorded sweep will make it again."""
    return key not in names and not store.path(key).exists()


def _leftovers(store: ArtifactStore, runs: Sequence[RecordedRun] | None) -> Iterator[Orphan]:
    for folder in _entries(store.root / "damaged"):
        yield Orphan("leftover", "damaged artifact that was set aside", (folder,))
    for place in (store.nodes, store.work, store.root / "artifacts"):
        for folder in _entries(place):
            if folder.name.startswith(".gone-"):
                yield Orphan("leftover", "what was being removed", (folder,))
    for folder in _entries(store.work):
        # Work begins under a hidden name, for less than a second.
        hidden = folder.name.startswith(".") and not folder.name.startswith(".gone-")
        if hidden and time.time() - _newest(folder) > _DAY:
            yield Orphan("leftover", "work that was never begun", (folder,))
    if runs is None:
        return
    known = {run.id for run in runs} | {_MODELS}
    for folder in _entries(store.root / "artifacts"):
        if folder.name not in known and not folder.name.startswith("."):
            yield Orphan("leftover", f"files of the run {folder.name}, which is gone", (folder,))


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _files(path: Path) -> Iterator[os.stat_result]:
    for file in [path] if path.is_file() else path.rglob("*"):
        with suppress(FileNotFoundError):  # a process that is at work there has removed it
            if file.is_file() and not file.is_symlink():
                yield file.stat()


def _newest(folder: Path) -> float:
    """When anything in a folder was last written; the folder itself if it is empty."""
    times = [file.st_mtime for file in _files(folder)]
    with suppress(FileNotFoundError):
        times = times or [folder.stat().st_mtime]
    return max(times, default=time.time())


def freed_bytes(paths: Iterable[Path]) -> int:
    """What removing all of these frees: nothing for a file that has a name elsewhere."""
    names: Counter[int] = Counter()
    files: dict[int, os.stat_result] = {}
    for path in paths:
        for file in _files(path):
            names[file.st_ino] += 1
            files[file.st_ino] = file
    return sum(f.st_size for inode, f in files.items() if f.st_nlink <= names[inode])
