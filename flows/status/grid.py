"""The cells of a sweep, by algorithm and dataset, and its components."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

from flows.pipeline.plan import Node
from flows.status.sweep_state import SweepState

__all__ = ["Part", "cell_nodes", "components", "grid"]

_NOT_VARIANT = ("algorithm", "dataset", "seed")


@dataclass
class Part:
    """How many of several are in which state.

    Attributes:
        total: Of them.
        done: Finished.
        running: Being computed.
        failed: Failed, or in need of a failed one.
        missing: Not begun, or waiting for more of their nodes; begun ones among them.
        fraction: Part of all work that is done, by planned cost.
    """

    total: int = 0
    done: int = 0
    running: int = 0
    failed: int = 0
    missing: int = 0
    fraction: float = 0.0
    _work: float = field(default=0.0, repr=False)
    _spent: float = field(default=0.0, repr=False)

    def add(self, nodes: Sequence[Node], state: SweepState) -> None:
        """Counts nodes that are done together, such as those of a cell, as one."""
        active = state.fractions
        self.total += 1
        keys = [node.key for node in nodes]
        if all(key in state.done for key in keys):
            self.done += 1
        elif any(key in state.failed or key in state.skipped for key in keys):
            self.failed += 1
        elif any(key in active for key in keys):
            self.running += 1
        else:
            self.missing += 1
        for node in nodes:
            part = active.get(node.key, state.begun.get(node.key, 0.0))
            self._work += node.cost
            self._spent += node.cost * (1.0 if node.key in state.done else part)
        self.fraction = self._spent / self._work

    def numbers(self) -> dict[str, float]:
        """Its attributes, for machines."""
        return {name: value for name, value in asdict(self).items() if name[0] != "_"}


def components(state: SweepState) -> dict[str, Part]:
    """The nodes of every component, in plan order."""
    found: dict[str, Part] = {}
    for node in state.plan or ():
        found.setdefault(node.component, Part()).add([node], state)
    return found


def grid(state: SweepState) -> dict[tuple[str, str], Part]:
    """By algorithm and dataset, the cells: all nodes of one seed."""
    found: dict[tuple[str, str], Part] = {}
    for pair, seeds in cell_nodes(state).items():
        for nodes in seeds.values():
            found.setdefault(pair, Part()).add(nodes, state)
    return found


def cell_nodes(state: SweepState) -> dict[tuple[str, str], dict[str, list[Node]]]:
    """By algorithm and dataset, and there by seed, the nodes of the cells.

    A variant of an algorithm is told from others by the setting that its nodes are tagged with.
    """
    cells: dict[tuple[str, str], dict[str, list[Node]]] = {}
    for node in state.plan or ():
        if {"algorithm", "dataset", "seed"} <= node.tags.keys():
            pair = _label(node.tags), node.tags["dataset"]
            cells.setdefault(pair, {}).setdefault(node.tags["seed"], []).append(node)
    return cells


def cells(state: SweepState) -> Counter[str]:
    """Numbers of cells in every state."""
    total: Counter[str] = Counter()
    for part in grid(state).values():
        total.update(
            total=part.total,
            done=part.done,
            running=part.running,
            failed=part.failed,
            missing=part.missing,
        )
    return total


def _label(tags: Mapping[str, str]) -> str:
    own = [f"{name}-{value}" for name, value in tags.items() if name not in _NOT_VARIANT]
    return "-".join([tags["algorithm"], *own])
