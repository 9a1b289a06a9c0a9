"""The state of a run: nodes per component, progress of running calls, time that remains."""

import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from flows.pipeline.computer import device_model
from flows.pipeline.costs import BOOKKEEPING, CostModel
from flows.pipeline.group import GroupResult
from flows.pipeline.plan import Node, Plan
from flows.pipeline.schedule import Group, simulate_schedule
from flows.pipeline.store import ArtifactStore

__all__ = ["ComponentState", "RunState"]

_ENOUGH = 0.02  # progress from which on a call's own speed replaces its planned cost


@dataclass(frozen=True)
class ComponentState:
    """The state of one component at one moment.

    Attributes:
        component: Its name.
        total: Nodes in the plan.
        reused: Of these, finished before this run.
        finished: Finished in this run.
        failed: Failed in this run.
        skipped: Not run because a failed node was needed.
        running: Nodes being computed.
        fraction: Part of the component's work that is done, running calls included.
        per_minute: Nodes finished per minute since the component's first start; None if unknown.
        remaining: Seconds until its last node is done; None if nothing is left.
        begun: Nodes that wait, but were begun in an earlier run and have a checkpoint.
    """

    component: str
    total: int
    reused: int
    finished: int
    failed: int
    skipped: int
    running: int
    fraction: float
    per_minute: float | None
    remaining: float | None
    begun: int = 0

    @property
    def done(self) -> int:
        """Nodes finished in this run or before."""
        return self.reused + self.finished

    @property
    def over(self) -> bool:
        """Whether every node is finished, failed or skipped."""
        return self.done + self.failed + self.skipped >= self.total


@dataclass
class _Call:
    """A call that the executor has taken."""

    group: Group
    since: float | None = None  # time at which the worker was first seen at work
    first: float = 0.0  # fraction done then: more than 0 if it continued from a checkpoint
    fraction: float = 0.0  # newest one read
    seen: float = 0.0  # time at which it was read


class RunState:
    """The state of a run: the runner reports events to it, the display reads it."""

    def __init__(
        self,
        plan: Plan,
        groups: Sequence[Group],
        store: ArtifactStore,
        slots: int,
        done: Collection[str],
        device: str = "cpu",
    ) -> None:
        """Starts with the finished nodes.

        Args:
            plan: The plan.
            groups: The groups to compute, in an order in which they can run.
            store: Where progress and measurements are read.
            slots: Groups that run at once.
            done: Keys finished before.
            device: Where groups run, "cpu" or "cuda".
        """
        self.plan = plan
        self.slots = slots
        self._store = store
        self._left = {group.name: group for group in groups}
        begun = store.begun()
        self._reached = {
            group.name: begun[keys] for group in groups if (keys := frozenset(group.keys)) in begun
        }
        self._running: dict[str, _Call] = {}
        self._begun: dict[str, float] = {}
        self._reused = Counter(plan[key].component for key in done)
        self._finished: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._total = plan.counts()
        self._work = {name: sum(n.cost for n in nodes) for name, nodes in self._components()}
        self._work_done = dict.fromkeys(self._total, 0.0)
        for key in done:
            self._work_done[plan[key].component] += plan[key].cost
        records = sorted(store.records(), key=lambda record: record.get("finished", 0.0))
        self.costs = CostModel(records, device, device_model(device))

    def _components(self) -> list[tuple[str, list[Node]]]:
        return list(self.plan.by_component().items())

    def begun(self, component: str | None = None) -> tuple[int, float]:
        """How many nodes have a checkpoint of an earlier run, and what part of them it holds.

        Args:
            component: Whose nodes; None for all.
        """
        groups = [
            (group, self._reached[name])
            for name, group in self._left.items()
            if name in self._reached and component in (None, group.component)
        ]
        cost = sum(node.cost for group, _ in groups for node in group.nodes)
        done = sum(node.cost * reached for group, reached in groups for node in group.nodes)
        return sum(len(group.nodes) for group, _ in groups), done / cost if cost else 0.0

    def submitted(self, name: str) -> None:
        """Notes that the executor has taken a group."""
        self._running[name] = _Call(self._left[name])
        self._begun.setdefault(self._left[name].component, time.monotonic())

    def ended(self, name: str, result: GroupResult) -> None:
        """Notes the result of a group."""
        call = self._running.pop(name, None)
        if result.stopped:
            self._reached[name] = call.fraction if call else 0.0
            return
        group = self._left.pop(name)
        self._reached.pop(name, None)
        self._finished[group.component] += len(result.finished)
        self._failed[group.component] += len(result.failed)
        for key in result.finished:
            self._work_done[group.component] += self.plan[key].cost
            self.costs.learn(self._store.record(key))

    def add(self, groups: Sequence[Group]) -> None:
        """Notes groups that take the place of one that has ended."""
        self._left |= {group.name: group for group in groups}

    def skipped(self, key: str) -> None:
        """Notes that a node will not be run."""
        self._skipped[self.plan[key].component] += 1
        self.postponed()

    def postponed(self) -> None:
        """Forgets the groups that have lost all their nodes."""
        self._left = {name: group for name, group in self._left.items() if group.nodes}

    def lost(self, key: str, *, reused: bool) -> None:
        """Notes that a node that counted as reused, or as finished in this run, is neither."""
        counter = self._reused if reused else self._finished
        counter[self.plan[key].component] -= 1
        self._work_done[self.plan[key].component] -= self.plan[key].cost

    def failed(self, key: str) -> None:
        """Notes that a node has failed outside of a group."""
        self._failed[self.plan[key].component] += 1

    def again(self, groups: Sequence[Group]) -> None:
        """Begins another pass, with these groups to compute; nothing runs."""
        self._left = {group.name: group for group in groups}

    def remaining(self) -> dict[str, float]:
        """Seconds until each component is done, for those that are not."""
        now = time.monotonic()
        seconds = {
            name: self._rest(name, group, now) + BOOKKEEPING * len(group.nodes)
            for name, group in self._left.items()
        }
        ends = simulate_schedule(self._left.values(), seconds, self.slots, self._running)
        last: dict[str, float] = {}
        for name, end in ends.items():
            component = self._left[name].component
            last[component] = max(last.get(component, 0.0), end)
        return last

    def _rest(self, name: str, group: Group, now: float) -> float:
        expected = self.costs.seconds(group.nodes)
        call = self._running.get(name)
        if call is None or call.since is None:
            return expected * (1.0 - self._reached.get(name, 0.0))
        gained = call.fraction - call.first
        if gained < _ENOUGH:
            return max(0.0, expected * (1.0 - call.fraction) - (now - call.since))
        speed = gained / max(1e-9, call.seen - call.since)
        return max(0.0, (1.0 - call.fraction) / speed - (now - call.seen))

    def _read_progress(self) -> None:
        now = time.monotonic()
        for name, call in self._running.items():
            fraction = self._store.fraction(name)
            if fraction is None:
                continue
            if call.since is None:
                call.since, call.first, call.seen = now, fraction, now
            if fraction != call.fraction:
                call.fraction, call.seen = fraction, now

    def components(self) -> list[ComponentState]:
        """The present state of every component, in plan order."""
        self._read_progress()
        remaining = self.remaining()
        active: Counter[str] = Counter()
        begun: Counter[str] = Counter()
        work = dict(self._work_done)
        for call in self._running.values():
            if call.since is not None:
                active[call.group.component] += len(call.group.nodes)
                work[call.group.component] += call.fraction * sum(n.cost for n in call.group.nodes)
        for name, group in self._left.items():
            call = self._running.get(name)
            if name in self._reached and (call is None or call.since is None):
                begun[group.component] += len(group.nodes)
                work[group.component] += self._reached[name] * sum(n.cost for n in group.nodes)
        return [
            ComponentState(
                component=name,
                total=total,
                reused=self._reused[name],
                finished=self._finished[name],
                failed=self._failed[name],
                skipped=self._skipped[name],
                begun=begun[name],
                running=active[name],
                fraction=min(1.0, work[name] / self._work[name]),
                per_minute=self._per_minute(name),
                remaining=remaining.get(name),
            )
            for name, total in self._total.items()
        ]

    def _per_minute(self, component: str) -> float | None:
        if not self._finished[component]:
            return None
        elapsed = time.monotonic() - self._begun[component]
        # The first moments measure how fast a process starts, not how fast it works.
        return 60.0 * self._finished[component] / elapsed if elapsed > 2.0 else None
