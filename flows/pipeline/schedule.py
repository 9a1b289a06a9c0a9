"""Groups of nodes, the order in which they start, and how long all of it takes.

What the longest chain of groups begins with starts first: that ends soonest. Where there is so much
to do that the last chain hardly counts, results come early instead: the cheapest first, with what
they need and others share.

The estimate simulates the list schedule with the order that the runner uses.
"""

import heapq
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from flows.pipeline.plan import Node, Plan, digest
from flows.pipeline.store import ArtifactStore

__all__ = ["Group", "form_groups", "halved", "simulate_schedule"]

_MANY = 10  # longest chains for each slot from which on results come early: a tenth more at worst


@dataclass(eq=False)
class Group:
    """Nodes computed in one task call.

    Attributes:
        name: Digest of the members' keys.
        nodes: The members.
        needs: Names of the groups that must finish before.
        priority: Cost of the longest chain of groups that starts here.
        early: Place of the first result that needs this group; 0 if results do not come early.
    """

    name: str
    nodes: list[Node]
    needs: set[str]
    priority: float = 0.0
    early: int = 0

    @property
    def order(self) -> tuple[int, float, str]:
        """Of groups that are ready, that with the least starts first."""
        return self.early, -self.priority, self.name

    @property
    def component(self) -> str:
        """The component of all members."""
        return self.nodes[0].component

    @property
    def keys(self) -> list[str]:
        """The members' keys."""
        return [node.key for node in self.nodes]


def form_groups(
    plan: Plan, pending: Iterable[str], store: ArtifactStore, slots: int | None = None
) -> list[Group]:
    """Divides the pending nodes into task calls, in an order in which they can run.

    Args:
        plan: The plan.
        pending: Keys of the nodes to compute.
        store: Where work begun earlier decides which nodes continue together.
        slots: How many groups run at once; None: results do not come early.

    Raises:
        ValueError: nodes with equal `lanes` need one another, directly or through others.
    """
    wanted = set(pending)
    lanes: dict[tuple[Any, ...], list[str]] = {}
    for node in plan:
        if node.key in wanted:
            alone = node.lanes or node.key
            identity = (node.component, node.task, node.version, bool(node.lanes), alone)
            lanes.setdefault(identity, []).append(node.key)
    groups = [
        Group(digest(sorted(keys)), [plan[key] for key in keys], set())
        for together in lanes.values()
        for keys in store.split(together)
    ]
    home = {key: group.name for group in groups for key in group.keys}
    for group in groups:
        group.needs = {
            home[source.key]
            for node in group.nodes
            for source in node.inputs.values()
            if source.key in home
        }
    groups = _in_order(groups)
    _prioritise(groups)
    longest = max((group.priority for group in groups), default=0.0)
    if slots is not None and sum(map(_cost, groups)) > _MANY * slots * longest:
        _results_early(groups)
    return groups


def halved(group: Group, keys: Collection[str]) -> list[Group]:
    """Two groups in the place of one.

    Args:
        group: The one.
        keys: Those of its nodes that are still to be computed, two at least.
    """
    nodes = [node for node in group.nodes if node.key in keys]
    middle = len(nodes) // 2
    return [
        Group(digest(sorted(n.key for n in part)), part, set(), group.priority, group.early)
        for part in (nodes[:middle], nodes[middle:])
    ]


def _in_order(groups: list[Group]) -> list[Group]:
    ordered: list[Group] = []
    done: set[str] = set()
    rest = groups
    while rest:
        ready = [group for group in rest if group.needs <= done]
        if not ready:
            raise ValueError(
                f"The lane group {rest[0].nodes[0].lanes!r} waits for itself: "
                "nodes that need one another must have different lanes."
            )
        ordered += ready
        done |= {group.name for group in ready}
        rest = [group for group in rest if group.name not in done]
    return ordered


def _prioritise(groups: list[Group]) -> None:
    by_name = {group.name: group for group in groups}
    for group in reversed(groups):
        group.priority += _cost(group)
        for need in group.needs:
            source = by_name[need]
            source.priority = max(source.priority, group.priority)


def _results_early(groups: list[Group]) -> None:
    """Gives every group the place of the cheapest result that needs it."""
    by_name = {group.name: group for group in groups}
    needed = {need for group in groups for need in group.needs}
    behind = {g.name: _upstream(g, by_name) for g in groups if g.name not in needed}
    costs = {name: sum(_cost(group) for group in above) for name, above in behind.items()}
    for place, name in enumerate(sorted(behind, key=lambda name: (costs[name], name)), start=1):
        for group in behind[name]:
            group.early = group.early or place


def _upstream(group: Group, by_name: Mapping[str, Group]) -> list[Group]:
    """A group and all that it needs, directly or through others."""
    found, left = {group.name: group}, [group]
    while left:
        for need in left.pop().needs - found.keys():
            found[need] = by_name[need]
            left.append(by_name[need])
    return list(found.values())


def _cost(group: Group) -> float:
    return sum(node.cost for node in group.nodes)


def simulate_schedule(
    groups: Iterable[Group],
    seconds: Mapping[str, float],
    slots: int,
    started: Collection[str] = (),
) -> dict[str, float]:
    """Simulates the list schedule.

    Args:
        groups: The groups not finished, in an order in which they can run.
        seconds: What each of them still takes, by name.
        slots: How many run at once.
        started: Names of those that run already.

    Returns:
        Seconds from now to the end of each group, by name.
    """
    waiting = {group.name: group for group in groups}
    missing = {name: group.needs & waiting.keys() for name, group in waiting.items()}
    followers: dict[str, list[str]] = {name: [] for name in waiting}
    for name, needs in missing.items():
        for need in needs:
            followers[need].append(name)
    ready = [
        (name not in started, *group.order) for name, group in waiting.items() if not missing[name]
    ]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    ends: dict[str, float] = {}
    now = 0.0
    while ready or running:
        while ready and len(running) < max(1, slots):
            *_, name = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[name], name))
        now, name = heapq.heappop(running)
        ends[name] = now
        for follower in followers[name]:
            missing[follower] = missing[follower] - {name}
            if not missing[follower]:
                heapq.heappush(ready, (True, *waiting[follower].order))
    return ends
