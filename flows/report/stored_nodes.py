"""The nodes of a sweep as its store remembers them, without the settings that planned them."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.configuration.checking import SettingsError
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, known_nodes, read_sweep, sweep_files

__all__ = ["StoredNode", "StoredSweep", "has_cells", "read_stored_sweep", "sweeps_of"]


@dataclass(frozen=True, eq=False)
class StoredNode:
    """A finished node; what reads plans reads it like a node of a plan.

    Attributes:
        key: Of its artifact.
        name: Of its run in the sweep.
        component: The stage it belongs to.
        config: The settings that decided its result.
        inputs: The nodes it was made from, by role.
        tags: Dataset, algorithm, seed.
        record: All of its `node.json`.
    """

    key: str
    name: str
    component: str
    config: Mapping[str, Any]
    inputs: Mapping[str, "StoredNode"]
    tags: Mapping[str, str]
    record: Mapping[str, Any]


@dataclass(frozen=True)
class StoredSweep:
    """A sweep in a store.

    Attributes:
        name: Its name.
        command: How it was begun.
        done: Its finished nodes whose inputs are there too, inputs first.
        missing: Run names of the others.
    """

    name: str
    command: str
    done: Sequence[StoredNode]
    missing: Sequence[str]

    def of(self, component: str) -> list[StoredNode]:
        """The finished nodes of a component."""
        return [node for node in self.done if node.component == component]

    @property
    def repeatable(self) -> str:
        """Its command without what changes no result: where its runs lie and how they are run."""
        words = shlex.split(self.command)
        return shlex.join(w for w in words if not w.startswith(("store=", "runner.")))

    def budget(self, counts: Iterable[int]) -> str:
        """Its profile and how many seeds its results have, for titles."""
        words = self.command.split()
        profile = next((w.partition("=")[2] for w in words if w.startswith("profile=")), "paper")
        seeds = sorted(set(counts))
        count = "–".join(map(str, dict.fromkeys((seeds[0], seeds[-1])))) if seeds else "no"
        return f"profile {profile}, {count} {'seed' if seeds == [1] else 'seeds'}"


def sweeps_of(root: Path) -> list[str]:
    """Names of the sweeps that a store has records of."""
    return [path.stem for path in sweep_files(root)]


def has_cells(root: Path, name: str) -> bool:
    """Whether a sweep is one of policies, not a search or a ranking."""
    return any(run.startswith("aggregate/") for run in known_nodes(root, name).values())


def read_stored_sweep(store: ArtifactStore, name: str) -> StoredSweep:
    """Read what is finished of a sweep.

    Raises:
        SettingsError: The store knows no such sweep.
        ValueError: Its record is damaged.
    """
    paths = {path.stem: path for path in sweep_files(store.root)}
    if name not in paths:
        known = ", ".join(sorted(paths)) or "none"
        raise SettingsError(f"sweep={name}: {store.root} has no such sweep; there are: {known}.")
    record = read_sweep(paths[name])
    found: dict[str, StoredNode | None] = {}
    for key in record.nodes:
        _read(store, record, key, found)
    done = [node for node in found.values() if node is not None]
    missing = [run for key, run in record.nodes.items() if found[key] is None]
    return StoredSweep(record.name, record.command, done, missing)


def _read(
    store: ArtifactStore, sweep: SweepRecord, key: str, found: dict[str, StoredNode | None]
) -> StoredNode | None:
    """A node and, before it, its inputs; None if any of them is not finished."""
    if key not in found:
        node = None
        if store.complete(key):
            record = store.record(key)
            inputs = {r: _read(store, sweep, k, found) for r, k in record["inputs"].items()}
            whole = {role: source for role, source in inputs.items() if source is not None}
            if len(whole) == len(inputs) and "config" in record:
                name = sweep.nodes.get(key, record["name"])
                kind, config = record["component"], record["config"]
                node = StoredNode(key, name, kind, config, whole, record.get("tags", {}), record)
        found[key] = node  # behind its inputs
    return found[key]
