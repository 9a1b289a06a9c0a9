"""The state of a sweep at one moment, as its store tells it."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from components.core.files import read_json
from flows.pipeline.costs import BOOKKEEPING, CostModel
from flows.pipeline.driver import DriverRecord, is_alive, read_driver
from flows.pipeline.plan import Plan
from flows.pipeline.schedule import form_groups, simulate_schedule
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord

__all__ = ["Call", "Phase", "SweepState", "phase_of", "read_state"]

_ENOUGH = 0.02  # progress from which on a call's own speed replaces its planned cost
Phase = Literal["running", "stopping", "ended", "killed", "unknown"]


@dataclass(frozen=True)
class Call:
    """Nodes that are being computed together.

    Attributes:
        nodes: Their keys.
        fraction: Part that is done.
        remaining: Seconds that are left; None if that is not known.
        host: The machine.
        pid: The process there.
    """

    nodes: Sequence[str]
    fraction: float
    remaining: float | None
    host: str
    pid: int


@dataclass(frozen=True)
class SweepState:
    """A sweep at one moment.

    Attributes:
        record: Its name, command and nodes.
        plan: Its nodes; None where an older version, or a search, has written the record.
        driver: What its driver has told last; None if none ever has.
        phase: Of the driver; "unknown" if none has told anything.
        done: Keys of finished nodes.
        failed: Last line of the reason by key; those of the present or last driver.
        skipped: By key of a node that cannot be run, the key of the failed one it needs.
        calls: What is being computed.
        begun: By key of a node that waits, the part of it that a checkpoint holds.
        remaining: Seconds until all is done, with as many calls at once as the driver has; None if
            nothing is left or it cannot be told.
        source: What that is made of.
    """

    record: SweepRecord
    plan: Plan | None
    driver: DriverRecord | None
    phase: Phase
    done: frozenset[str]
    failed: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    calls: Sequence[Call] = ()
    begun: Mapping[str, float] = field(default_factory=dict)
    remaining: float | None = None
    source: str = ""

    @property
    def fractions(self) -> dict[str, float]:
        """By key, the part that is done of nodes being computed."""
        return {key: call.fraction for call in self.calls for key in call.nodes}


def read_state(
    store: ArtifactStore, record: SweepRecord, clock: Callable[[], float] = time.time
) -> SweepState:
    """The state of a sweep now.

    Args:
        store: The store; reading again with the same object is faster.
        record: Of the sweep.
        clock: Seconds since 1970.

    Raises:
        ValueError: The record of the sweep is damaged.
    """
    now = clock()
    plan = record.remembered()
    driver = read_driver(store.root, record.name)
    phase = phase_of(store, driver, now)
    done = frozenset(key for key in record.nodes if store.path(key).is_dir())
    failed = _of(driver.failed if driver else {}, record, done)
    skipped = _of(driver.skipped if driver else {}, record, done)
    state = SweepState(record, plan, driver, phase, done, failed, skipped)
    if plan is None:
        return state
    # Checkpoints and measurements first: a call may end while it is being looked at.
    begun = {key: part for keys, part in store.begun().items() for key in keys}
    costs = _costs(store, plan, driver)
    living = phase in ("running", "stopping")
    calls = _calls(store, plan, driver, done, costs, now) if driver is not None and living else []
    active = {key for call in calls for key in call.nodes}
    begun = {k: part for k, part in begun.items() if k in plan and k not in active | done}
    slots = driver.slots if driver else 1
    left = [k for k in record.nodes if k not in done and k not in failed and k not in skipped]
    remaining = _remaining(store, plan, left, calls, begun, costs, slots)
    return SweepState(
        record, plan, driver, phase, done, failed, skipped, calls, begun, remaining, costs.source
    )


def phase_of(store: ArtifactStore, driver: DriverRecord | None, now: float) -> Phase:
    """What a driver is doing.

    Args:
        store: The store.
        driver: What it has told last; None if nothing.
        now: Seconds since 1970.
    """
    if driver is None:
        return "unknown"
    if driver.ended:
        return "ended"
    if not is_alive(store.root, driver, now):
        return "killed"
    return "stopping" if driver.stopping else "running"


def _of(told: Mapping[str, str], record: SweepRecord, done: frozenset[str]) -> dict[str, str]:
    """What a driver has told of nodes of the sweep as it is now."""
    return {key: text for key, text in told.items() if key in record.nodes and key not in done}


def _costs(store: ArtifactStore, plan: Plan, driver: DriverRecord | None) -> CostModel:
    """Learned from the sweep's own finished nodes."""
    finished = [store.record(n.key) for n in plan if store.complete(n.key)]
    finished.sort(key=lambda record: record.get("finished", 0.0))
    return CostModel(finished, driver.device if driver else "cpu")


def _calls(
    store: ArtifactStore,
    plan: Plan,
    driver: DriverRecord,
    done: frozenset[str],
    costs: CostModel,
    now: float,
) -> list[Call]:
    """What workers report; a group whose worker has not begun yet waits."""
    calls = []
    for group, keys in driver.running.items():
        report = read_json(store.progress_file(group))
        nodes = [plan[key] for key in keys if key in plan and key not in done]
        if nodes and isinstance(report, dict) and "host" in report:
            rest = _rest(report, costs.seconds(nodes), now)
            fraction, host, pid = float(report["fraction"]), report["host"], report["pid"]
            calls.append(Call([node.key for node in nodes], fraction, rest, host, pid))
    return calls


def _rest(report: Mapping[str, Any], expected: float, now: float) -> float:
    """Seconds that a call still takes: at its own pace, or at first at that of others."""
    gained = report["fraction"] - report["began_at"]
    spent = max(0.0, report["at"] - report["began"])
    since = max(0.0, now - report["at"])
    if gained < _ENOUGH or not spent:
        return max(0.0, expected * (1.0 - report["began_at"]) - spent - since)
    return max(0.0, (1.0 - report["fraction"]) * spent / gained - since)


def _remaining(
    store: ArtifactStore,
    plan: Plan,
    left: Sequence[str],
    calls: Sequence[Call],
    begun: Mapping[str, float],
    costs: CostModel,
    slots: int,
) -> float | None:
    if not left:
        return None
    groups = form_groups(plan, left, store, slots)
    running = {key: call for call in calls for key in call.nodes}
    seconds, started = {}, []
    for group in groups:
        call = next((running[key] for key in group.keys if key in running), None)
        if call is not None and call.remaining is not None:
            seconds[group.name] = call.remaining
            started.append(group.name)
        else:
            reached = min(begun.get(key, 0.0) for key in group.keys)
            seconds[group.name] = costs.seconds(group.nodes) * (1.0 - reached)
        seconds[group.name] += BOOKKEEPING * len(group.nodes)
    return max(simulate_schedule(groups, seconds, slots, started).values(), default=None)
