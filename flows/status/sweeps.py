"""The sweeps of a store: which there are, and which one is meant."""

import time
from dataclasses import dataclass
from pathlib import Path

from flows.configuration.checking import SettingsError, StoreFolder, StrictModel
from flows.pipeline.driver import read_driver
from flows.pipeline.remote.bringing import glance
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, read_sweep, sweep_files
from flows.status.sweep_state import Phase, phase_of

__all__ = ["Listed", "SweepWords", "chosen", "listed", "open_store"]

_RUNNING = ("running", "stopping")


class SweepWords(StrictModel):
    """Which sweep of which store."""

    sweep: str | None = None
    store: StoreFolder = Path("mlruns")


@dataclass(frozen=True)
class Listed:
    """A sweep in a list.

    Attributes:
        record: Of it.
        phase: Of its driver.
        done: Finished nodes.
    """

    record: SweepRecord
    phase: Phase
    done: int


def listed(store: ArtifactStore) -> list[Listed]:
    """All sweeps of a store.

    Raises:
        ValueError: A record is damaged.
    """
    found = []
    for path in sweep_files(store.root):
        record = read_sweep(path)
        phase = phase_of(store, read_driver(store.root, record.name), time.time())
        done = sum(store.path(key).is_dir() for key in record.nodes)
        found.append(Listed(record, phase, done))
    return found


def chosen(store: ArtifactStore, name: str | None) -> SweepRecord | None:
    """The sweep that is meant: of this name, the only one, or the only one that runs.

    Returns:
        None if there are several and no name tells them apart.

    Raises:
        SettingsError: There is none of this name, or none at all.
        ValueError: A record is damaged.
    """
    paths = {path.stem: path for path in sweep_files(store.root)}
    known = ", ".join(sorted(paths)) or "none"
    if not paths or (name and name not in paths):
        asked = f"sweep={name}: " if name else ""
        raise SettingsError(f"{asked}{store.root} has no such sweep; there are: {known}.")
    if name or len(paths) == 1:
        return read_sweep(paths[name or next(iter(paths))])
    running = [sweep.record for sweep in listed(store) if sweep.phase in _RUNNING]
    return running[0] if len(running) == 1 else None


def open_store(words: SweepWords) -> ArtifactStore:
    """The store, to read only.

    Raises:
        SettingsError: There is none.
    """
    store = glance(words.store)
    if not store.nodes.is_dir():
        raise SettingsError(
            f"store={words.store} holds no runs; give the folder that a sweep has made."
        )
    return store
