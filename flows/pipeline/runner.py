"""Runs a plan: reuses finished nodes, starts those that are ready, records those that ended.

The driver may be killed at any line. A node is finished when its artifact folder exists. Everything
else, such as the tracker's record, follows from that and is completed at the next start.
"""

import signal
import time
from dataclasses import dataclass, field

from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.executor import Executor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.run_state import RunState
from flows.pipeline.schedule import Group, form_groups
from flows.pipeline.signals import deferred_signals, exit_code, ignored_signals
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import Tracker
from flows.pipeline.worker import GroupCall, GroupResult

__all__ = ["Outcome", "run_plan"]

_TICK = 0.5  # seconds between two looks at the display
_TRACKER_PAUSE = 60.0  # seconds before a tracker that refused is asked again


@dataclass
class Outcome:
    """How a run of a plan ended.

    Attributes:
        finished: Keys computed in this run.
        reused: Keys that were finished before.
        failed: Traceback or reason by key.
        skipped: By key of a node not run, the key of the failed node it needs.
        interrupted: The exit code for the signal that ended the run, such as Ctrl-C; 0 for none.
        unrecorded: Why the tracker lacks finished nodes; empty if it lacks none.
    """

    finished: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    interrupted: int = 0
    unrecorded: str = ""

    @property
    def complete(self) -> bool:
        """Whether every node of the plan is finished."""
        return not (self.failed or self.skipped or self.interrupted)

    @property
    def status(self) -> str:
        """FINISHED, FAILED or KILLED."""
        if self.interrupted:
            return "KILLED"
        return "FINISHED" if self.complete else "FAILED"

    @property
    def may_take_time(self) -> bool:
        """Whether a report may be written: who sends SIGTERM or SIGHUP soon sends SIGKILL."""
        return self.interrupted in (0, 128 + signal.SIGINT)

    @property
    def exit_code(self) -> int:
        """0 if all is finished and recorded, 130 after Ctrl-C, 143 after SIGTERM, else 1."""
        if self.interrupted:
            return self.interrupted
        return 0 if self.complete and not self.unrecorded else 1


def run_plan(
    plan: Plan,
    store: ArtifactStore,
    tracker: Tracker,
    display: Display,
    *,
    executor: Executor,
    command: str = "the same command",
) -> Outcome:
    """Computes everything in the plan that is not finished yet.

    Args:
        plan: The nodes to compute.
        store: Where artifacts lie.
        tracker: Records finished and failed nodes; the caller has opened it.
        display: Shows the progress.
        executor: Computes groups of nodes.
        command: How to continue after an interrupt, for the message.

    Returns:
        How every node ended. Nothing is raised for failed nodes.

    Raises:
        PipelineError: the sweep could not start at all.
    """
    return _Run(plan, store, tracker, display, executor, command).run()


class _Run:
    """One pass over a plan."""

    def __init__(
        self,
        plan: Plan,
        store: ArtifactStore,
        tracker: Tracker,
        display: Display,
        executor: Executor,
        command: str,
    ) -> None:
        self.plan = plan
        self.store = store
        self.tracker = tracker
        self.display = display
        self.executor = executor
        self.command = command
        self.outcome = Outcome()
        self.waiting: dict[str, Group] = {}
        self.running: dict[str, Group] = {}
        self.unrecorded: list[tuple[Node, str | None]] = []
        self.tracker_closed_until = float("-inf")
        self.tracker_warned = False

    def run(self) -> Outcome:
        self.store.repair()
        self.outcome.reused = [node.key for node in self.plan if self.store.complete(node.key)]
        done = set(self.outcome.reused)
        pending = [node.key for node in self.plan if node.key not in done]
        groups = form_groups(self.plan, pending, self.store)
        self.waiting = {group.name: group for group in groups}
        self.run_state = RunState(self.plan, groups, self.store, self.executor.slots, done)
        self.display.start(self.run_state)
        try:
            if groups:
                self.executor.start(self.display.note)
                self.run_state.slots = self.executor.slots
                self._submit()
            for key in self.outcome.reused:
                self._record(self.plan[key], None)
            while self.running:
                self._step()
            self._retry_tracker(last=True)
        except KeyboardInterrupt:
            self.outcome.interrupted = exit_code()
        finally:
            with ignored_signals() if self.outcome.interrupted else deferred_signals():
                self.executor.stop()
                self.display.stop(self.run_state)
        if self.unrecorded:
            self.display.note(
                f"{len(self.unrecorded)} nodes are not in the tracker yet, but safe on disk. "
                f"Record them with: {self.command}"
            )
        if self.outcome.interrupted:
            self.display.note(
                f"Interrupted; nothing finished is lost. Continue with: {self.command}"
            )
        return self.outcome

    def _step(self) -> None:
        results = self.executor.wait(_TICK)
        records: list[tuple[Node, str | None]] = []
        for result in results:
            records += self._settle(result)
        # Workers first: writing to the tracker may take seconds, in which they would idle.
        self._submit()
        for node, reason in records:
            self._record(node, reason)
        self._retry_tracker()
        self.display.update(self.run_state)

    def _submit(self) -> None:
        # One more than can run, so that no worker idles while the tracker is being written.
        room = self.executor.slots + 1 - len(self.running)
        settled = self.waiting.keys() | self.running.keys()
        ready = sorted(
            (group for group in self.waiting.values() if not group.needs & settled),
            key=lambda group: (-group.priority, group.name),
        )
        for group in ready[: max(0, room)]:
            del self.waiting[group.name]
            self.running[group.name] = group
            self.store.clear_progress(group.name)
            self.executor.submit(
                GroupCall.of(
                    group.name,
                    self.store.root,
                    group.nodes,
                    self.executor.device,
                    self.executor.threads,
                )
            )
            self.run_state.submitted(group.name)

    def _settle(self, result: GroupResult) -> list[tuple[Node, str | None]]:
        group = self.running.pop(result.group)
        self.store.clear_progress(group.name)
        for key in [key for key in result.failed if self.store.complete(key)]:
            # Published by a worker that died before it returned its result.
            result.finished.append(key)
            del result.failed[key]
        self.run_state.ended(group.name, result)
        self.outcome.finished += result.finished
        records: list[tuple[Node, str | None]] = [(self.plan[k], None) for k in result.finished]
        for key, reason in result.failed.items():
            records.append((self.plan[key], reason))
            self.outcome.failed[key] = reason
            last = (reason.strip() or "no reason given").splitlines()[-1]
            self.display.note(f"{self.plan[key].component} {self.plan[key].name} failed: {last}")
            for node in self.plan.downstream(key):
                self._skip(node, key)
        return records

    def _skip(self, node: Node, because: str) -> None:
        if node.key in self.outcome.skipped or self.store.complete(node.key):
            return
        self.outcome.skipped[node.key] = because
        for name, group in list(self.waiting.items()):
            # The others of the group run without it.
            group.nodes = [member for member in group.nodes if member.key != node.key]
            if not group.nodes:
                del self.waiting[name]
        self.run_state.skipped(node.key)

    def _record(self, node: Node, reason: str | None) -> None:
        if time.monotonic() < self.tracker_closed_until:
            self.unrecorded.append((node, reason))
            return
        try:
            if reason is None:
                self.tracker.log_node(node, self.store.path(node.key))
            else:
                self.tracker.log_failure(node, reason)
        except TrackingError as error:
            if not self.tracker_warned:
                self.display.note(f"{error} The work goes on.")
                self.tracker_warned = True
            self.outcome.unrecorded = str(error)
            self.unrecorded.append((node, reason))
            self.tracker_closed_until = time.monotonic() + _TRACKER_PAUSE

    def _retry_tracker(self, *, last: bool = False) -> None:
        if last:
            self.tracker_closed_until = float("-inf")
        if not self.unrecorded or time.monotonic() < self.tracker_closed_until:
            return
        again, self.unrecorded = self.unrecorded, []
        self.outcome.unrecorded = ""
        for node, reason in again:
            self._record(node, reason)
