"""The groups that wait, and which start next; what a step costs does not grow with them."""

import heapq
from collections.abc import Collection, Iterable, Iterator

from flows.pipeline.schedule import Group

__all__ = ["Waiting"]


class Waiting:
    """Groups that have not started, or are to start again.

    A group is ready when no group that it needs waits or runs: a failed one is no longer needed,
    since whatever had to have it has been withdrawn.
    """

    def __init__(self, groups: Iterable[Group] = ()) -> None:
        """Takes groups in an order in which they can run."""
        self._groups: dict[str, Group] = {}
        self._home: dict[str, str] = {}  # name of the group by key
        self._open: set[str] = set()  # names of groups that wait or run
        self._missing: dict[str, set[str]] = {}  # open needs by name
        self._followers: dict[str, set[str]] = {}  # who misses a group, by name
        self._ready: list[tuple[tuple[int, float, str], str]] = []
        for group in groups:
            self.add(group)

    def __contains__(self, name: object) -> bool:
        return name in self._groups

    def __iter__(self) -> Iterator[Group]:
        return iter(list(self._groups.values()))

    def add(self, group: Group) -> None:
        """Puts a group in line; one that has been taken may come back."""
        self._groups[group.name] = group
        self._open.add(group.name)
        self._home |= dict.fromkeys(group.keys, group.name)
        self._missing[group.name] = missing = group.needs & self._open
        for need in missing:
            self._followers.setdefault(need, set()).add(group.name)
        self._offer(group.name)

    def take(self) -> Group | None:
        """The next group to start; None if none is ready. It is open until it has `left`."""
        while self._ready:
            _, name = heapq.heappop(self._ready)
            if name in self._groups:  # otherwise it was withdrawn
                return self._groups.pop(name)
        return None

    def left(self, name: str) -> None:
        """Notes that a taken group has ended, so that others may start."""
        self._open.discard(name)
        for follower in self._followers.pop(name, ()):
            self._missing[follower].discard(name)
            self._offer(follower)

    def divide(self, group: Group, parts: Collection[Group]) -> None:
        """Puts groups in the place of one that was taken; those that missed it miss its parts."""
        followers = self._followers.pop(group.name, set())
        for part in parts:
            self.add(part)
        for follower in followers:
            self._missing[follower] |= {part.name for part in parts}
            for part in parts:
                self._followers.setdefault(part.name, set()).add(follower)
        self.left(group.name)
        for follower in followers:
            self._missing[follower].discard(group.name)

    def withdraw(self, keys: Iterable[str]) -> None:
        """Takes nodes from waiting groups; the others of a group run without them."""
        wanted: dict[str, set[str]] = {}
        for key in keys:
            if self._home.get(key) in self._groups:
                wanted.setdefault(self._home[key], set()).add(key)
        for name, gone in wanted.items():
            group = self._groups[name]
            group.nodes = [node for node in group.nodes if node.key not in gone]
            if not group.nodes:
                del self._groups[name]
                self.left(name)

    def _offer(self, name: str) -> None:
        if name in self._groups and not self._missing[name]:
            heapq.heappush(self._ready, (self._groups[name].order, name))
