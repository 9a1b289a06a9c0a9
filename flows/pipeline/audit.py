"""What a plan finds in a store: finished nodes that can be reused, damaged ones, stale ones.

Every finished node's `node.json`, its small files and the sizes of its large files are compared
with what was written. Large files are read where pending nodes will read them, and in nodes that
no other one reads, the results of the plan; whoever else reads a file later verifies it then.

A node is stale if an input that it read has other files now: then it is made again, and so on
downwards. An input that was made again to the same bytes changes nothing.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from components.core.integrity import DamagedFileError
from components.core.sealed import content_digest, is_sealed
from flows.pipeline.errors import StoreError
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore

__all__ = ["Audit", "audit"]


@dataclass(frozen=True)
class Audit:
    """The state of a plan's nodes.

    Attributes:
        finished: Keys of nodes that can be reused.
        unusable: Why a node that is there has to be made again, a sentence by key.
        stale: Which of these are sound, but made from another input than there is now.
        places: Inode of the folder of every node that is there, which names it for good.
        unsealed: How many of the finished ones carry no digests, coming from an older version.
        other_code: How many of them were made by other code of the same version, by what it is.
    """

    finished: frozenset[str]
    unusable: Mapping[str, str]
    stale: frozenset[str]
    places: Mapping[str, int]
    unsealed: int
    other_code: Mapping[str, int] = field(default_factory=dict)

    def refuse(self) -> None:
        """Stops here if anything is unusable.

        Raises:
            StoreError: names the first file and node, and the remedy.
        """
        for number, sentence in enumerate(self.unusable.values()):
            others = len(self.unusable) - number - 1
            raise StoreError(
                f"{sentence}{f' ({others} more like it)' if others else ''}; runner.repair=refuse "
                "leaves it as it is: give the command with runner.repair=recompute to have it made "
                "again."
            )

    def holds(self, store: ArtifactStore, plan: Plan) -> bool:
        """Whether the same folders are there as then: none has come, gone or been replaced."""
        return all(store.place(node.key) == self.places.get(node.key) for node in plan)

    def lines(self) -> list[str]:
        """A sentence about everything that has to be made again."""
        return [f"{sentence}: it is made again." for sentence in self.unusable.values()]


def audit(plan: Plan, store: ArtifactStore, suspects: Mapping[str, str] | None = None) -> Audit:
    """Looks at all nodes of a plan; changes nothing, but brings here what a shared store has.

    Args:
        plan: The plan.
        store: The store.
        suspects: What somebody said about an artifact that could not be read, by key. One that has
            its digests is read again; another one is believed to be damaged.
    """
    store.fetch(node.key for node in plan)
    return _Audit(plan, store, suspects or {}).result()


class _Audit:
    def __init__(self, plan: Plan, store: ArtifactStore, suspects: Mapping[str, str]) -> None:
        self.plan, self.store, self.suspects = plan, store, suspects
        self.records: dict[str, dict[str, Any]] = {}
        self.unusable: dict[str, str] = {}
        self.stale: set[str] = set()
        self.places: dict[str, int] = {}

    def result(self) -> Audit:
        for node in self.plan:
            place = self.store.place(node.key)
            if node.key in self.store.refused:
                self._reject(node, self.store.refused[node.key])
            elif place is not None:
                self.places[node.key] = place
                self._look(node, large=False)
        for node in self.plan:
            if node.key in self.records:
                self._compare_inputs(node)
        self._read_what_is_needed()
        unsealed = sum(not is_sealed(record) for record in self.records.values())
        finished, stale = frozenset(self.records), frozenset(self.stale)
        other = self._other_code()
        return Audit(finished, self.unusable, stale, self.places, unsealed, other)

    def _look(self, node: Node, *, large: bool) -> None:
        try:
            suspect = node.key in self.suspects
            record = self.store.check(node.key, large=large or suspect, fresh=suspect)
            if suspect and not is_sealed(record):
                self._reject(node, self.suspects[node.key])
            else:
                self.records[node.key] = record
        except DamagedFileError as error:
            self._reject(node, error.sentence)

    def _reject(self, node: Node, sentence: str) -> None:
        self.records.pop(node.key, None)
        self.unusable[node.key] = f"{sentence}, of {node.component} {node.name}"

    def _compare_inputs(self, node: Node) -> None:
        """Rejects a node if an input is another one than it read; a pending input is judged later.

        Inputs come before the nodes that read them, so what depends on a rejected node waits.
        """
        read: Mapping[str, str | None] = self.records[node.key].get("content", {})
        for role, source in node.inputs.items():
            if read.get(role) is None or source.key not in self.records:
                continue
            present = content_digest(self.records[source.key]) or self.store.content(source.key)
            if present != read[role]:
                said = (
                    f"{self.store.path(node.key)} was made from another {role!r} than there is now"
                )
                self._reject(node, said)
                self.stale.add(node.key)
                return

    def _other_code(self) -> Counter[str]:
        """Counts finished nodes whose records tell another code than the plan's nodes have.

        Digests by another Python's parser cannot be compared, and older records tell none.
        """
        found: Counter[str] = Counter()
        for node in self.plan:
            was = str(self.records.get(node.key, {}).get("code", ""))
            if was != node.code and was.partition(":")[0] == node.code.partition(":")[0]:
                kind = node.tags.get("model") or node.tags.get("algorithm") or node.name
                found[f"{node.component} of {kind}"] += 1
        return found

    def _read_what_is_needed(self) -> None:
        """Reads results and inputs of pending nodes; a damaged one is pending itself, and so on."""
        read: set[str] = set()
        while True:
            needed = {
                node.key: node
                for node in self.plan
                if node.key in self.records and node.key not in read
                if not (dependents := self.plan.dependents(node.key))
                or any(dependent.key not in self.records for dependent in dependents)
            }
            if not needed:
                return
            read |= needed.keys()
            for node in needed.values():
                self._look(node, large=True)
