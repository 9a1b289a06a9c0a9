"""Plans: graphs of nodes, each identified by a digest of everything that decides its result.

A node's key covers its component and version, the name of its task function, its configuration
and the keys of its inputs, but no path, computer, run name, tag or worker count. Two sweeps that
need the same node therefore share its artifact.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

__all__ = ["Node", "Plan", "canonical_json", "digest"]


def canonical_json(value: Any) -> str:
    """The JSON text of a value that is equal for equal values: sorted keys, no blanks, no NaN.

    Raises:
        TypeError: the value holds something JSON cannot.
        ValueError: the value holds NaN or infinity, or mappings with keys that collide as text.
    """
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True
    )


def digest(value: Any, size: int = 16) -> str:
    """Hexadecimal SHA-256 of a value's canonical JSON, cut to `size` bytes."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[: 2 * size]


@dataclass(frozen=True, eq=False)
class Node:
    """One component run.

    Attributes:
        component: The stage it belongs to, e.g. "policy_training".
        name: Run name in displays and trackers, e.g. "lion/mediocre-0.2/seed0". Not in the key.
        task: Import path of the task function, "package.module:function".
        version: Version of the component's code; raise it when results change.
        config: All settings that can change the result; JSON-able.
        inputs: The nodes whose artifacts it reads, by role.
        folders: Absolute folders outside the store that it reads, by role. Not in the key: the
            configuration holds digests of what must lie there.
        tags: Dataset, algorithm, seed; trackers find nodes by them. Not in the key.
        lanes: Pending nodes with the same non-empty value are computed in one task call.
        cost: Rough core-seconds, for the order of work and the estimate.
        code: Digest of the code that is this node's alone, such as an algorithm's module; empty if
            it is not told. Not in the key, which has `version`: a finished node of other code is
            used, and that is said.
    """

    component: str
    name: str
    task: str
    version: int
    config: Mapping[str, Any]
    inputs: Mapping[str, "Node"] = field(default_factory=dict)
    folders: Mapping[str, str] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    lanes: str = ""
    cost: float = 1.0
    code: str = ""

    def __post_init__(self) -> None:
        if self.task.count(":") != 1:
            raise ValueError(
                f"The task {self.task!r} of node {self.name!r} is no import path; "
                "write it as 'package.module:function'."
            )
        if not self.cost > 0:
            raise ValueError(f"The cost of node {self.name!r} must be positive, not {self.cost}.")

    @cached_property
    def key(self) -> str:
        """32 hexadecimal digits; equal for equal results.

        Raises:
            ValueError: the configuration is not JSON.
        """
        try:
            return digest(
                {
                    "component": self.component,
                    # The function, not its module: moving code to another file changes no result.
                    "function": self.task.partition(":")[2],
                    "version": self.version,
                    "config": self.config,
                    "inputs": {role: node.key for role, node in self.inputs.items()},
                }
            )
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"The configuration of node {self.name!r} is not plain JSON: {error}."
            ) from error


class Plan:
    """Nodes in an order in which they can be computed, with everything they need, each key once."""

    def __init__(self, nodes: Iterable[Node]) -> None:
        """Collects the nodes and, transitively, their inputs.

        Args:
            nodes: The wanted nodes. Duplicates by key are merged; the first one names the run.
        """
        self._by_key: dict[str, Node] = {}
        self._dependents: dict[str, list[Node]] = {}
        for node in nodes:
            self._add(node)
        for node in self._by_key.values():
            for source in {source.key for source in node.inputs.values()}:
                self._dependents[source].append(node)

    def _add(self, node: Node) -> None:
        if node.key in self._by_key:
            return
        for source in node.inputs.values():
            self._add(source)
        self._by_key[node.key] = node
        self._dependents[node.key] = []

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, inputs before the nodes that read them."""
        return tuple(self._by_key.values())

    def __len__(self) -> int:
        return len(self._by_key)

    def __iter__(self) -> Iterator[Node]:
        return iter(self._by_key.values())

    def __contains__(self, key: object) -> bool:
        return key in self._by_key

    def __getitem__(self, key: str) -> Node:
        return self._by_key[key]

    def by_component(self) -> dict[str, list[Node]]:
        """Nodes of each component, components in the order in which they first occur."""
        components: dict[str, list[Node]] = {}
        for node in self:
            components.setdefault(node.component, []).append(node)
        return components

    def counts(self) -> Counter[str]:
        """Number of nodes per component."""
        return Counter(node.component for node in self)

    def dependents(self, key: str) -> tuple[Node, ...]:
        """The nodes that read this one directly."""
        return tuple(self._dependents[key])

    def downstream(self, key: str) -> tuple[Node, ...]:
        """All nodes that need this one, directly or through others, in plan order."""
        needed = {key}
        for node in self:
            if any(source.key in needed for source in node.inputs.values()):
                needed.add(node.key)
        return tuple(node for node in self if node.key in needed and node.key != key)
