"""The sweeps of a store and their nodes: STORE/sweeps/NAME.json.

Work that no sweep can continue and artifacts that no sweep reads are found by these records. A
sweep writes its record when it begins, so that what it makes belongs to it from the first moment;
with another plan under the same name the record is replaced.

The record of a sweep also holds its plan but for the configurations, so that others can tell what
is missing, what it is for and how long it takes. That of a search has none: its nodes are chosen
one after the other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from components.core.cards import CardFormat
from components.core.files import write_json
from components.core.sealed import check_digest, with_digest
from flows.pipeline.plan import Node, Plan

__all__ = ["SweepRecord", "known_nodes", "read_sweep", "sweep_files"]

_STORED = ("component", "task", "version", "tags", "lanes", "cost")  # of a node of a plan

_VERSION = ("format_version", 1)
_REMEDY = "give the sweep's command again to write it"


@dataclass(frozen=True)
class SweepRecord:
    """A sweep or a search.

    Attributes:
        name: Its name.
        command: How it was begun.
        nodes: Run name by key; of a search, those of the trials asked for so far.
        plan: A description of every node, inputs first; None for a search, and where an older
            version has written the record.
    """

    name: str
    command: str
    nodes: Mapping[str, str]
    plan: Sequence[Mapping[str, Any]] | None = None

    @classmethod
    def of(cls, name: str, command: str, plan: Plan) -> "SweepRecord":
        """The record of a sweep over a plan."""
        described = [
            {field: getattr(node, field) for field in _STORED}
            | {"key": node.key, "inputs": {role: n.key for role, n in node.inputs.items()}}
            for node in plan
        ]
        return cls(name, command, {node.key: node.name for node in plan}, described)

    def remembered(self) -> Plan | None:
        """The plan, of nodes without configurations; None if the record has none.

        Raises:
            ValueError: It is not what a version of this package writes.
        """
        if self.plan is None:
            return None
        nodes: dict[str, Node] = {}
        try:
            for fields in self.plan:
                key = fields["key"]
                inputs = {role: nodes[source] for role, source in fields["inputs"].items()}
                described = {name: fields[name] for name in _STORED}
                name = self.nodes[key]
                nodes[key] = _Remembered(
                    **described, name=name, config={}, inputs=inputs, remembered=key
                )
        except (KeyError, TypeError, AttributeError) as error:
            said = f"The plan in the record of sweep {self.name!r} is damaged"
            raise ValueError(f"{said}; {_REMEDY}.") from error
        return Plan(nodes.values())

    def save(self, root: Path) -> None:
        """Writes it into a store.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        path = _folder(root) / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {"name": self.name, "command": self.command, "nodes": dict(self.nodes)}
        content |= {} if self.plan is None else {"plan": self.plan}
        write_json(path, dict([_VERSION]) | with_digest(content))


@dataclass(frozen=True, eq=False)
class _Remembered(Node):
    """A node whose key is known without its configuration."""

    remembered: str = ""

    @cached_property
    def key(self) -> str:
        """As it was stored."""
        return self.remembered


_FORMAT = CardFormat(
    kind=SweepRecord,
    what="record of a sweep",
    remedy=_REMEDY,
    version=_VERSION,
    amend=check_digest,
)


def read_sweep(path: Path) -> SweepRecord:
    """Reads one of the `sweep_files`.

    Raises:
        ValueError: The file is damaged or of another version.
    """
    return _FORMAT.read(path)


def known_nodes(root: Path, name: str) -> dict[str, str]:
    """The nodes on the record of a sweep; none if there is no readable one."""
    try:
        return dict(read_sweep(_folder(root) / f"{name}.json").nodes)
    except (FileNotFoundError, ValueError):
        return {}


def sweep_files(root: Path) -> list[Path]:
    """The records of a store."""
    return sorted(path for path in _folder(root).glob("*.json") if not path.name.startswith("."))


def _folder(root: Path) -> Path:
    return root / "sweeps"
