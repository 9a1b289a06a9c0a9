"""Damage: files of a store that are not what was written."""

import json
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from components.core.sealed import is_sealed
from components.core.tensors import load_tensors
from components.reporting.stored import ReportNodes
from flows.pipeline.json_lines import read_lines
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import read_sweep, sweep_files

__all__ = ["Damage", "Nodes", "check_nodes", "check_records", "check_work"]


@dataclass(frozen=True)
class Damage:
    """A file that cannot be used as it is.

    Attributes:
        sentence: What is wrong; it names the file.
        key: The node whose artifact or work it belongs to; empty if it belongs to none.
    """

    sentence: str
    key: str = ""


@dataclass(frozen=True)
class Nodes:
    """The finished artifacts of a store.

    Attributes:
        checked: How many there are.
        unsealed: Folders of those without digests, made by an older version.
        damages: What is wrong with the others.
    """

    checked: int
    unsealed: tuple[Path, ...]
    damages: tuple[Damage, ...]


def check_nodes(store: ArtifactStore, progress: Callable[[int], None]) -> Nodes:
    """Read every file of every finished artifact.

    Args:
        store: The store.
        progress: Called with the number of artifacts that have been read.
    """
    unsealed, damages, checked = [], [], 0
    for folder in sorted(store.nodes.iterdir()) if store.nodes.is_dir() else ():
        if folder.name.startswith("."):
            continue
        try:
            if not is_sealed(store.check(folder.name, fresh=True)):
                unsealed.append(folder)
        except (ValueError, OSError) as error:
            damages.append(Damage(_sentence(error, folder), folder.name))
        checked += 1
        progress(checked)
    return Nodes(checked, tuple(unsealed), tuple(damages))


def check_work(store: ArtifactStore) -> list[Damage]:
    """Read every checkpoint of work that no living process holds, and what it is work for."""
    damages: list[Damage] = []
    for work in store.work_folders():
        with store.locked(work.serves, wait=False) as free:
            if not free:
                continue
            for path in sorted(work.path.rglob("*.safetensors")):
                damages += _tried(load_tensors, path, min(work.serves))
    for folder in store.useless_work():
        said = f"{folder} does not say what it was begun for: the next sweep removes it."
        damages.append(Damage(said))
    return damages


def check_records(store: ArtifactStore) -> list[Damage]:
    """Read what sweeps, reports, trackers and searches have written beside the artifacts."""
    damages = []
    for path in sweep_files(store.root):
        damages += _tried(read_sweep, path)
    for path in sorted(store.root.glob("reports/*/report.json")):
        damages += _tried(lambda path: ReportNodes.load(path.parent), path)
    for path in sorted(store.root.glob("tracking/*.jsonl")):
        damages += _tried(read_lines, path)
    for path in (store.root / "optuna" / "journal.log", store.root / "mlflow.db"):
        if path.exists():
            damages += _tried(_read_database if path.suffix == ".db" else read_lines, path)
    return damages


def _read_database(path: Path) -> None:
    # To SQLite, an empty file is a database without tables; so is one that was begun just now.
    if path.stat().st_size == 0 and any(path.parent.glob("artifacts/*")):
        raise ValueError("it is empty, and there are files of runs")
    connection = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)
    try:
        [found] = connection.execute("pragma quick_check(1)").fetchone()
    finally:
        connection.close()
    if found != "ok":
        raise ValueError(f"SQLite finds: {found.splitlines()[-1]}")


def _tried(reader: Callable[[Path], Any], path: Path, key: str = "") -> Iterator[Damage]:
    try:
        reader(path)
    except FileNotFoundError:
        return  # removed meanwhile by its owner
    except (ValueError, OSError, sqlite3.Error) as error:
        yield Damage(_sentence(error, path), key)


def _sentence(error: Exception, path: Path) -> str:
    text = str(error).strip().rstrip(".") or type(error).__name__
    if isinstance(error, json.JSONDecodeError) or str(path) not in text:
        text = f"{path} is damaged ({text})"
    return f"{text}."
