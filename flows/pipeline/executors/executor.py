"""What the runner needs of an executor."""

from collections.abc import Callable
from typing import Protocol

from flows.pipeline.group import GroupCall, GroupResult

__all__ = ["Executor"]


class Executor(Protocol):
    """Computes groups of nodes.

    Attributes:
        slots: Groups that can run at once.
        device: "cpu" or "cuda".
        threads: Threads per group.
        precision: Of a GPU's products of float32, see :func:`.computer.set_precision`.
    """

    slots: int
    device: str
    threads: int
    precision: str

    def start(self, notify: Callable[[str], None], watch: Callable[[], None] = ...) -> None:
        """Gets ready.

        Args:
            notify: Takes one-line messages.
            watch: Called at every report by executors that compute inside `wait`, so that the
                caller can read the losses reported so far.
        """

    def submit(self, call: GroupCall) -> None:
        """Takes a group."""

    def wait(self, timeout: float) -> list[GroupResult]:
        """Groups that ended, after at most `timeout` seconds; may be none."""

    def stop(self) -> None:
        """Ends everything that still runs."""
