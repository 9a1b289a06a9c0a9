"""Verify a store and find what nothing in it needs: ``python -m flows.verify [--prune]``."""

import shutil
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pydantic import Field
from rich.console import Console

from components.core.sealed import read_record, seal
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.pipeline.leftovers import store_alone
from flows.pipeline.remote.bringing import bring
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, read_sweep, sweep_files
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_board import KEY_OF
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_leftovers import delete_row
from flows.pipeline.tracking.mlflow_setup import LEADERBOARD
from flows.verification.damage import Damage, Nodes, check_nodes, check_records, check_work
from flows.verification.orphans import Orphan, RecordedRow, RecordedRun, find_orphans, freed_bytes

__all__ = ["VerifySettings", "load_verify_settings", "verify"]

HELP = """\
usage: python -m flows.verify [KEY=VALUE ...]

Read everything in a store. Named are files that are not what was written, and orphans: what no
sweep of the store needs, with what it costs. The exit code is 1 if anything is damaged, else 0.

  store=mlruns   folder of the runs
  prune=true     remove the orphans after naming them; --prune means the same
  days=30        unfinished work that has not been touched for so many days is an orphan, too
  seal=true      record digests of finished artifacts that an older version made without; --seal
                 means the same. What they hold now is taken to be right.

Damaged artifacts are made again by the command of their sweep. Nothing that a running process uses
is an orphan, and nothing is removed while a sweep uses the store.
"""


class VerifySettings(StrictModel):
    """What to verify, and what to do about it."""

    store: StoreFolder = Path("mlruns")
    prune: bool = False
    days: float = Field(default=30.0, ge=0)
    seal: bool = False


def load_verify_settings(words: Sequence[str]) -> VerifySettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, switches=["prune", "seal"])
    if fields.get("store") == "":
        raise SettingsError("store= is empty; name a folder, e.g. store=mlruns.")
    settings: VerifySettings = build_config(VerifySettings, "", fields)
    store = settings.store.expanduser()
    bring(store)
    if not (store / "nodes").is_dir():
        raise SettingsError(f"store={store} holds no runs; give the folder that a sweep has made.")
    return settings.model_copy(update={"store": store})


def verify(settings: VerifySettings) -> int:
    """Verify a store, say what was found, and tidy up as far as that is asked for.

    Returns:
        The exit code.

    Raises:
        TrackingError: MLflow cannot be used.
        ValueError: What is needed is not known, because a record of it is damaged.
    """
    store = ArtifactStore(settings.store, create=False)
    nodes = _read_nodes(store)
    records = check_records(store)
    damages = [*nodes.damages, *check_work(store), *records]
    sweeps = _readable_sweeps(store)
    print(f"{settings.store}/: {nodes.checked} finished artifacts, {len(sweeps)} recorded sweeps.")
    for damage in damages:
        print(f"damaged: {damage.sentence}{_needed_by(damage, sweeps)}")
    if nodes.unsealed:
        _seal(store, nodes, seal_now=settings.seal)
    if records and settings.prune:
        print("Nothing is removed: what is needed is not known while a record is damaged.")
        return 1
    if not records and settings.prune:
        _prune(store, settings)
    elif not records:
        _offer(store, settings)
    if not damages:
        print("Nothing is damaged.")
    return int(bool(damages))


def _read_nodes(store: ArtifactStore) -> Nodes:
    console = Console(stderr=True)
    if not console.is_terminal:
        return check_nodes(store, lambda number: None)
    with console.status("reading") as status:
        return check_nodes(store, lambda number: status.update(f"{number} artifacts read"))


def _readable_sweeps(store: ArtifactStore) -> list[SweepRecord]:
    found = []
    for path in sweep_files(store.root):
        try:
            found.append(read_sweep(path))
        except (ValueError, FileNotFoundError):
            continue  # named among the damages
    return found


def _needed_by(damage: Damage, sweeps: Sequence[SweepRecord]) -> str:
    """The sweep whose command makes a damaged artifact again."""
    for sweep in sweeps:
        if damage.key in sweep.nodes:
            return f" It is {sweep.nodes[damage.key]}; make it again with: {sweep.command}"
    return ""


def _seal(store: ArtifactStore, nodes: Nodes, *, seal_now: bool) -> None:
    number = len(nodes.unsealed)
    if not seal_now:
        print(
            f"{number} artifacts were made without digests by an older version and cannot be "
            "checked. Record what they hold now with: python -m flows.verify --seal"
        )
        return
    for folder in nodes.unsealed:
        with store.locked([folder.name], wait=False) as free:
            if free and folder.is_dir():
                seal(folder, read_record(folder))
    print(f"{number} artifacts of an older version have digests now.")


def _recorded_runs(store: ArtifactStore) -> list[RecordedRun] | None:
    """All runs of the store's own database; None if it has none or a server keeps them."""
    experiment = _own_experiment(store)
    if experiment is None:
        return None
    return [
        RecordedRun(
            run.info.run_id,
            run.data.tags.get("key", ""),
            run.info.run_name,
            run.data.tags.get("role") == "node"
            and (run.info.status, run.info.lifecycle_stage) == ("FINISHED", "active"),
        )
        for run in experiment.search("", deleted=True)
    ]


def _recorded_rows(store: ArtifactStore) -> list[RecordedRow]:
    """All rows of the leaderboard in the store's own database."""
    board = _leaderboard(store)
    return [
        RecordedRow(
            run.info.run_id,
            run.info.run_name,
            frozenset(key for tag, key in run.data.tags.items() if tag.startswith(KEY_OF)),
        )
        for run in (() if board is None else board.search("tags.role = 'row'"))
    ]


def _leaderboard(store: ArtifactStore) -> MlflowExperiment | None:
    """The leaderboard in the store's own database; None if it has none."""
    runs = _own_experiment(store)
    if runs is None or runs.client.get_experiment_by_name(LEADERBOARD) is None:
        return None
    return MlflowExperiment(store.root, name=LEADERBOARD)


def _own_experiment(store: ArtifactStore) -> MlflowExperiment | None:
    address = StoreAddress(store.root)
    if not (address.own and address.database.exists()):
        return None
    return MlflowExperiment(store.root)


def _prune(store: ArtifactStore, settings: VerifySettings) -> None:
    """Remove the orphans. A sweep that begins meanwhile waits: it might need one of them."""
    store.locks.mkdir(exist_ok=True)
    with store_alone(store) as (alone, _):
        if not alone:
            print("Nothing is removed: a sweep is using the store; try again when it has ended.")
            return
        orphans = _name_orphans(store, settings)
        summary, total = _summary(orphans)
        _delete_runs(store, [orphan.run for orphan in orphans if orphan.kind == "run"])
        _delete_rows(store, [orphan.run for orphan in orphans if orphan.kind == "row"])
        removed = sum(_remove(store, orphan) for orphan in orphans)
    if orphans:
        freed = f", which frees {total}" if removed == len(orphans) else ""
        print(f"{summary}; {removed} removed{freed}.")


def _offer(store: ArtifactStore, settings: VerifySettings) -> None:
    """Name the orphans and say how they are removed."""
    orphans = _name_orphans(store, settings)
    summary, total = _summary(orphans)
    if orphans:
        print(f"{summary}. Removing them frees {total}: python -m flows.verify --prune")


def _name_orphans(store: ArtifactStore, settings: VerifySettings) -> list[Orphan]:
    runs, rows = _recorded_runs(store), _recorded_rows(store)
    orphans = find_orphans(store, _readable_sweeps(store), runs, settings.days, rows)
    if not StoreAddress(store.root).own:
        unsure = [orphan for orphan in orphans if orphan.kind == "artifact"]
        orphans = [orphan for orphan in orphans if orphan.kind != "artifact"]
        if unsure:
            print(
                f"{len(unsure)} artifacts of no recorded sweep or report are kept: the runs at "
                "MLFLOW_TRACKING_URI, which may name them, are not read."
            )
    for orphan in orphans:
        where = ", ".join(str(path.relative_to(store.root)) for path in orphan.paths)
        size = _size(freed_bytes(orphan.paths))
        print(f"orphan: {orphan.kind}, {orphan.what}" + (f" ({where}, {size})" if where else ""))
    return orphans


def _summary(orphans: Sequence[Orphan]) -> tuple[str, str]:
    """How many there are of each kind, and what removing all of them frees."""
    kinds = Counter(orphan.kind for orphan in orphans)
    counts = ", ".join(f"{number} of kind {kind}" for kind, number in kinds.items())
    size = freed_bytes(path for orphan in orphans for path in orphan.paths)
    return f"Orphans: {counts}", _size(size)


def _delete_runs(store: ArtifactStore, runs: Sequence[str]) -> None:
    experiment = _own_experiment(store) if runs else None
    if experiment is not None:
        with experiment.writing():
            for run in runs:
                experiment.client.delete_run(run)


def _delete_rows(store: ArtifactStore, rows: Sequence[str]) -> None:
    board = _leaderboard(store) if rows else None
    if board is not None:
        with board.writing():
            for row in rows:
                delete_row(board, board.client.get_run(row))


def _remove(store: ArtifactStore, orphan: Orphan) -> bool:
    """Remove an orphan unless a process is at work on it now."""
    with store.locked(orphan.keys, wait=False) as free:
        if not free:
            print(f"kept: {orphan.what}; a process is at work on it")
            return False
        for path in orphan.paths:
            # Renamed first: a kill in the middle leaves no half of an artifact under its name.
            doomed = path if path.name.startswith(".") else path.with_name(f".gone-{path.name}")
            with suppress(FileNotFoundError):  # its owner has ended, and removed it
                path.rename(doomed)
                is_folder = doomed.is_dir() and not doomed.is_symlink()
                shutil.rmtree(doomed) if is_folder else doomed.unlink()
        return True


def _size(number: float) -> str:
    for unit in ("B", "kB", "MB"):
        if number < 1000:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} GB"


if __name__ == "__main__":
    run_door("verify", HELP, load_verify_settings, verify)
