"""How a run of a plan ended."""

import signal
from dataclasses import dataclass, field

__all__ = ["Outcome"]


@dataclass
class Outcome:
    """How a run of a plan ended.

    Attributes:
        finished: Keys computed in this run.
        reused: Keys that were finished before.
        failed: Traceback or reason by key.
        skipped: By key of a node not run, the key of the failed node it needs.
        interrupted: The exit code for the signal that ended the run, such as Ctrl-C; 0 for none.
        damaged: A sentence by key of a finished node that the tracker could not read.
        unrecorded: Why the tracker lacks finished nodes; empty if it lacks none.
    """

    finished: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    interrupted: int = 0
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
        return self.interrupted in (0, 128 + signal.SIGINT)

    @property
    def exit_code(self) -> int:
        """0 if all is finished and recorded, 130 after Ctrl-C, 143 after SIGTERM, else 1."""
        if self.interrupted:
            return self.interrupted
        return 0 if self.complete and not self.unrecorded and not self.damaged else 1
