"""An executor that computes in this process, for tests and debugging."""

from collections.abc import Callable

from flows.pipeline.group import GroupCall, GroupResult
from flows.pipeline.worker import run_group

__all__ = ["SerialExecutor"]


class SerialExecutor:
    """Runs every group in this process, one after the other."""

    def __init__(
        self,
        *,
        threads: int = 1,
        device: str = "cpu",
        slots: int = 1,
        precision: str = "highest",
    ) -> None:
        """Takes threads per group, device and precision; `slots` serves estimates only."""
        self.slots = slots
        self.threads = threads
        self.device = device
        self.precision = precision
        self._calls: list[GroupCall] = []
        self._watch: Callable[[], None] = lambda: None

    def start(
        self, notify: Callable[[str], None], watch: Callable[[], None] = lambda: None
    ) -> None:
        """Keeps `watch`, which the work in `wait` calls."""
        self._watch = watch

    def submit(self, call: GroupCall) -> None:
        """Puts the group in line."""
        self._calls.append(call)

    def wait(self, timeout: float) -> list[GroupResult]:
        """Runs the first group in line."""
        return [run_group(self._calls.pop(0), self._watch)] if self._calls else []

    def stop(self) -> None:
        """Forgets what is in line."""
        self._calls.clear()
