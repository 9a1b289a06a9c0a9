"""Runs a plan: reuses finished nodes, starts those that are ready, records those that ended.

The driver may be killed at any line. A node is finished when its artifact folder exists. Everything
else, such as the tracker's record, follows from that and is completed at the next start.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from flows.pipeline.audit import Audit, audit
from flows.pipeline.driver import Driver
from flows.pipeline.executors.executor import Executor
from flows.pipeline.failures import REPAIR_REMEDY, failure_line
from flows.pipeline.group import GroupCall, GroupResult
from flows.pipeline.outcome import Outcome
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.recording import Recorder
from flows.pipeline.repair import Repairs
from flows.pipeline.run_state import RunState
from flows.pipeline.schedule import Group, form_groups, halved
from flows.pipeline.signals import deferred_signals, exit_code, ignored_signals
from flows.pipeline.stopping import Stop
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import Tracker
from flows.pipeline.waiting import Waiting

__all__ = ["Outcome", "run_plan"]

_TICK = 0.5  # seconds between two looks at the display


def run_plan(
    plan: Plan,
    store: ArtifactStore,
    tracker: Tracker,
    display: Display,
    *,
    executor: Executor,
    command: str = "the same command",
    repairs: bool = True,
    driver: Driver | None = None,
    found: Audit | None = None,
) -> Outcome:
    """Computes everything in the plan that is not finished yet.

    Args:
        plan: The nodes to compute.
        store: Where artifacts lie.
        tracker: Records finished and failed nodes; the caller has opened it.
        display: Shows the progress.
        executor: Computes groups of nodes.
        command: How to continue after an interrupt, for the message.
        repairs: Whether what is damaged on the disk is made again, with all that depends on it.
        driver: Tells others how the run goes, and knows when it is to stop.
        found: What the plan has found in the store, if somebody has looked a moment ago.

    Returns:
        How every node ended. Nothing is raised for failed nodes.

    Raises:
        PipelineError: the sweep could not start at all; StoreError if something is damaged and
            `repairs` is False.
    """
    return _Run(plan, store, tracker, display, executor, command, repairs, driver, found).run()


@dataclass
class _Run:
    """A plan is gone over once, and again if something finished turns out to be damaged.

    Nothing is set aside while groups run: they may be reading it.
    """

    plan: Plan
    store: ArtifactStore
    tracker: Tracker
    display: Display
    executor: Executor
    command: str
    repairs: bool
    driver: Driver | None
    found: Audit | None

    def __post_init__(self) -> None:
        self.stop = Stop(self.store, self.driver, self.display.note)
        self.outcome = Outcome()
        self.waiting = Waiting()
        self.running: dict[str, Group] = {}
        self.started = False
        self.suspects: dict[str, str] = {}  # why a finished node could not be read, by key
        self.postponed: set[str] = set()  # keys that wait for another pass
        self.new: set[str] = set()  # keys finished since the last look at the store
        self.repair = Repairs(self.store, self.display.note)
        self.recorder = Recorder(self.tracker, self.store, self.display.note)

    def run(self) -> Outcome:
        for sentence in self.store.repair():
            self.display.note(sentence)
        found = self.found
        if found is None or not found.holds(self.store, self.plan):
            found = audit(self.plan, self.store)
        if self.repairs:
            self._set_aside(found)
        else:
            found.refuse()
        self.outcome.reused = [node.key for node in self.plan if node.key in found.finished]
        pending = [node.key for node in self.plan if node.key not in found.finished]
        groups = form_groups(self.plan, pending, self.store, self.executor.slots)
        self.run_state = RunState(
            self.plan,
            groups,
            self.store,
            self.executor.slots,
            found.finished,
            self.executor.device,
        )
        self.display.start(self.run_state)
        try:
            self._begin(groups)
            for key in list(self.outcome.reused):
                self._record(self.plan[key], None)
            self._finish_pass()
            while self._begin_another_pass() or self._retry_tracker():
                self._finish_pass()
            if self.stop.why:
                self.outcome.end_stop(self.stop.why, self.plan)
        except KeyboardInterrupt:
            self.outcome.interrupted = exit_code()
        finally:
            with ignored_signals() if self.outcome.interrupted else deferred_signals():
                if self.outcome.interrupted and not self.stop.why:
                    self.display.note("Ending what runs ...")  # which may take seconds
                self.executor.stop()
                self._look(last=True)
                self.stop.forget(self.running)
                self.display.stop(self.run_state)
        self.outcome.unrecorded = self.recorder.refusal
        for sentence in self.outcome.sentences(self.command, len(self.recorder.waiting)):
            self.display.note(sentence)
        return self.outcome

    def _begin(self, groups: list[Group]) -> None:
        self.waiting = Waiting(groups)
        if groups and not self.started:
            self.executor.start(self.display.note, self._look)
            self.run_state.slots = self.executor.slots
            self.started = True
        self._submit()

    def _finish_pass(self) -> None:
        while self.running and not self.stop.over:
            self._step()

    def _look(self, *, last: bool = False) -> None:
        """Tells others how the run goes, and asks what runs to end if it is to stop."""
        self.stop.look(self.outcome, self.running, self.executor, last=last)

    def _begin_another_pass(self) -> bool:
        """Makes again what was found damaged, and what was made from another input."""
        if self.stop.why:
            return False  # the next start finds what is damaged
        done = {*self.outcome.reused, *self.outcome.finished} - self.new
        doubtful = any(n.key in done for key in self.new for n in self.plan.dependents(key))
        if not (self.suspects or self.postponed or doubtful):
            return False
        found = audit(self.plan, self.store, self.suspects)
        if not self.repairs:
            self._name_damage(found.unusable)
            return False
        self._set_aside(found)
        self.suspects, self.postponed, self.new = {}, set(), set()
        ended = self.outcome.failed.keys() | self.outcome.skipped.keys()
        # What another driver has finished meanwhile is pending, too: a worker finds it there.
        kept = found.finished & {*self.outcome.reused, *self.outcome.finished}
        pending = [n.key for n in self.plan if n.key not in kept and n.key not in ended]
        if not pending:
            return False
        self._forget(pending)
        groups = form_groups(self.plan, pending, self.store, self.executor.slots)
        self.run_state.again(groups)
        self._begin(groups)
        return True

    def _retry_tracker(self) -> bool:
        """Records what is left; whether that has begun another pass."""
        self.recorder.retry(last=True)
        self._take_unreadable()
        return self._begin_another_pass()

    def _set_aside(self, found: Audit) -> None:
        for key, reason in self.repair.set_aside(found, self.suspects).items():
            if key not in self.outcome.failed:
                self._forget([key])
                self.run_state.failed(key)
                self._fail(key, reason)
                self._record(self.plan[key], reason)

    def _forget(self, keys: Collection[str]) -> None:
        """Takes nodes from those that are done."""
        for done in (self.outcome.reused, self.outcome.finished):
            for key in [key for key in done if key in keys]:
                done.remove(key)
                self.run_state.lost(key, reused=done is self.outcome.reused)

    def _name_damage(self, damage: Mapping[str, str]) -> None:
        for key in damage.keys() - self.outcome.damaged.keys():
            self.outcome.damaged[key] = f"{damage[key]}; {REPAIR_REMEDY}."
            self.display.note(self.outcome.damaged[key])

    def _step(self) -> None:
        self._look()
        results = self.executor.wait(_TICK)
        records: list[tuple[Node, str | None]] = []
        for result in results:
            records += self._settle(result)
        # Workers first: writing to the tracker may take seconds, in which they would idle.
        self._submit()
        for node, reason in records:
            self._record(node, reason)
        self.recorder.retry()
        self._take_unreadable()
        self.display.update(self.run_state)

    def _submit(self) -> None:
        if self.stop.why:
            return
        # One more than can run, so that no worker idles while the tracker is being written.
        while len(self.running) <= self.executor.slots and (group := self.waiting.take()):
            self.running[group.name] = group
            self.store.clear_progress(group.name)
            call = GroupCall.of(
                group.name,
                self.store.root,
                group.nodes,
                self.executor.device,
                self.executor.threads,
                self.repairs,
                self.executor.precision,
            )
            self.executor.submit(self.store.sent(call))
            self.run_state.submitted(group.name)

    def _settle(self, result: GroupResult) -> list[tuple[Node, str | None]]:
        group = self.running.pop(result.group)
        self.store.clear_progress(group.name)
        self.store.fetch(group.keys)
        for sentence in result.notes:
            self.display.note(sentence)
        for key in [key for key in result.failed if self.store.complete(key)]:
            # Published by a worker that died before it returned its result.
            result.finished.append(key)
            del result.failed[key]
        why = dict(result.damaged)
        for key in [key for key in result.finished if not self.store.complete(key)]:
            why[key] = f"{self.store.path(key)} was damaged when it had just been made"
            result.finished.remove(key)
        ended = {*result.finished, *result.failed, *result.stopped, *result.too_many}
        left = [key for key in group.keys if key not in ended]
        if why and self.repairs:
            self.suspects |= why
            self._postpone(left)
        else:
            reason = f"{'; '.join(why.values()) or 'The worker gave no reason'}; {REPAIR_REMEDY}."
            result.failed |= dict.fromkeys(left, reason)
        if result.stopped and not self.stop.why:
            self.waiting.add(group)  # another driver's stop: both compute this group
        elif not result.too_many:
            self.waiting.left(group.name)
        self.run_state.ended(group.name, result)
        if result.too_many:
            self._halve(group, result.too_many)
        self.outcome.finished += result.finished
        self.new |= set(result.finished)
        records: list[tuple[Node, str | None]] = [(self.plan[k], None) for k in result.finished]
        for key, reason in result.failed.items():
            records.append((self.plan[key], reason))
            self._fail(key, reason)
        return records

    def _halve(self, group: Group, keys: Sequence[str]) -> None:
        """Computes nodes for which there was no room together in two parts."""
        halves = halved(group, keys)
        self.waiting.divide(group, halves)
        self.run_state.add(halves)
        memory = "The GPU's memory" if self.executor.device == "cuda" else "Memory"
        self.display.note(
            f"{memory} ran out with {len(keys)} lanes, {group.nodes[0].name} and others: going on "
            f"with {' and '.join(str(len(half.nodes)) for half in halves)}."
        )

    def _fail(self, key: str, reason: str) -> None:
        self.outcome.failed[key] = reason
        last = failure_line(reason)
        self.display.note(f"{self.plan[key].component} {self.plan[key].name} failed: {last}")
        for node in self.plan.downstream(key):
            self._skip(node, key)

    def _skip(self, node: Node, because: str) -> None:
        if node.key in self.outcome.skipped or self.store.complete(node.key):
            return
        self.outcome.skipped[node.key] = because
        self.waiting.withdraw([node.key])
        self.run_state.skipped(node.key)

    def _postpone(self, keys: Sequence[str]) -> None:
        """Leaves nodes, and what needs them, to another pass."""
        self.postponed |= set(keys)
        for key in keys:
            self.waiting.withdraw(node.key for node in self.plan.downstream(key))
        self.run_state.postponed()

    def _record(self, node: Node, reason: str | None) -> None:
        self.recorder.record(node, reason)
        self._take_unreadable()

    def _take_unreadable(self) -> None:
        """An artifact that the tracker could not read is made again, or named."""
        if self.repairs:
            self.suspects |= self.recorder.unreadable
        else:
            self._name_damage(
                {
                    key: f"{sentence}, of {self.plan[key].component} {self.plan[key].name}"
                    for key, sentence in self.recorder.unreadable.items()
                }
            )
        self.recorder.unreadable.clear()
