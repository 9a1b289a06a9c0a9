"""What an executor asks of a process, and what it hears back: nodes that are computed together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.pipeline.plan import Node

__all__ = ["GroupCall", "GroupResult"]


@dataclass(frozen=True)
class GroupCall:
    """Nodes to be computed in one task call; plain data, so that any computer can take it.

    Attributes:
        group: Name of the group, for its progress file.
        root: Absolute folder of the store.
        task: Import path of the task function.
        nodes: Per node its key, name, component, version, config, input keys and folders by
            role, tags, cost.
        device: "cpu" or "cuda".
        threads: Threads to use.
        precision: Of a GPU's products, see :func:`.computer.set_precision`.
        repairs: Whether damaged work is thrown away and begun anew; it fails otherwise.
        url: Of a store that machines share; its copy here takes the place of `root`.
        owner: The driver, for which nodes of such a store are claimed.
    """

    group: str
    root: str
    task: str
    nodes: tuple[Mapping[str, Any], ...]
    device: str = "cpu"
    threads: int = 1
    repairs: bool = True
    precision: str = "highest"
    url: str = ""
    owner: str = ""

    @classmethod
    def of(
        cls,
        group: str,
        root: Path,
        nodes: Sequence[Node],
        device: str = "cpu",
        threads: int = 1,
        repairs: bool = True,
        precision: str = "highest",
    ) -> "GroupCall":
        """Describes nodes, all of one task, as plain data."""
        described = tuple(
            {
                "key": node.key,
                "name": node.name,
                "component": node.component,
                "version": node.version,
                "config": dict(node.config),
                "inputs": {role: source.key for role, source in node.inputs.items()},
                "folders": dict(node.folders),
                "tags": dict(node.tags),
                "cost": node.cost,
                "code": node.code,
            }
            for node in nodes
        )
        task = nodes[0].task
        return cls(group, str(root), task, described, device, threads, repairs, precision)

    @property
    def title(self) -> str:
        """The group's first node and how many more, for messages."""
        first = self.nodes[0]["name"]
        return first if len(self.nodes) == 1 else f"{first} and {len(self.nodes) - 1} more"


@dataclass
class GroupResult:
    """How the nodes of a group ended; those in none of its parts have to be computed again.

    Attributes:
        group: Name of the group.
        finished: Keys that are now complete in the store.
        failed: Traceback or reason per key.
        stopped: Keys whose computation the driver has stopped, for good or at a checkpoint.
        too_many: Keys of a call that ran out of memory; fewer at once may have room.
        damaged: Why an input could not be read, by its key.
        notes: What people should know, a sentence each.
    """

    group: str
    finished: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    stopped: list[str] = field(default_factory=list)
    too_many: list[str] = field(default_factory=list)
    damaged: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
