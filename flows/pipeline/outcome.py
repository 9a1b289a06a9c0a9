"""How a run of a plan ended."""

import signal
from collections.abc import Iterable
from dataclasses import dataclass, field

from flows.pipeline.plan import Node

__all__ = ["STOPPED", "Outcome"]

STOPPED = 75
"""Exit code of a run that stopped as it was asked to; sysexits.h: try again later."""


@dataclass
class Outcome:
    """How a run of a plan ended.

    Attributes:
        finished: Keys computed in this run.
        reused: Keys that were finished before.
        failed: Traceback or reason by key.
        skipped: By key of a node not run, the key of the failed node it needs.
        interrupted: The exit code for what ended the run, such as Ctrl-C; 0 for nothing.
        stopped: Why the run was asked to stop, as a clause; empty if it was not, or has finished.
        damaged: A sentence by key of a finished node that the tracker could not read.
        unrecorded: Why the tracker lacks finished nodes; empty if it lacks none.
    """

    finished: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    interrupted: int = 0
    stopped: str = ""
    damaged: dict[str, str] = field(default_factory=dict)
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
        return self.interrupted in (0, 128 + signal.SIGINT, STOPPED)

    def end_stop(self, why: str, plan: Iterable[Node]) -> None:
        """Notes that the run has stopped, unless every node has ended.

        Args:
            why: As a clause.
            plan: All nodes.
        """
        ended = {*self.finished, *self.reused, *self.failed, *self.skipped}
        if any(node.key not in ended for node in plan):
            self.interrupted, self.stopped = STOPPED, why

    def sentences(self, command: str, unrecorded: int) -> list[str]:
        """What people should know at the end.

        Args:
            command: How to continue.
            unrecorded: Finished nodes that the tracker lacks.
        """
        said = []
        if unrecorded:
            said.append(
                f"{unrecorded} nodes are not in the tracker yet, but safe on disk. "
                f"Record them with: {command}"
            )
        if self.interrupted:
            how = f"Stopped, since {self.stopped}" if self.stopped else "Interrupted"
            said.append(f"{how}; nothing finished is lost. Continue with: {command}")
        return said

    @property
    def exit_code(self) -> int:
        """0 if all is finished and recorded, 130 after Ctrl-C, 143 after SIGTERM, else 1.

        75 after a stop that was asked for.
        """
        if self.interrupted:
            return self.interrupted
        return 0 if self.complete and not self.unrecorded and not self.damaged else 1
