"""A clean stop: nothing new begins, and what runs ends at its next checkpoint."""

import time
from collections.abc import Callable, Iterable, Mapping

from flows.pipeline.driver import Driver
from flows.pipeline.executors.executor import Executor
from flows.pipeline.outcome import Outcome
from flows.pipeline.schedule import Group
from flows.pipeline.store import ArtifactStore

__all__ = ["PATIENCE", "Stop"]

PATIENCE = 120.0  # seconds; a training saves itself every 20 to 60


class Stop:
    """Whether a run is stopping.

    Attributes:
        why: The reason, as a clause; empty while the run goes on.
    """

    def __init__(
        self,
        store: ArtifactStore,
        driver: Driver | None,
        note: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Takes the store, who may know a reason to stop, and what shows a message."""
        self.why = ""
        self._store, self._driver, self._note, self._clock = store, driver, note, clock
        self._since = 0.0

    def look(
        self,
        outcome: Outcome,
        running: Mapping[str, Group],
        executor: Executor,
        *,
        last: bool = False,
    ) -> None:
        """Tells the driver how the run goes, and asks running groups to end if it is to stop.

        Args:
            outcome: Of the run so far.
            running: Groups that the executor has taken, by name.
            executor: Computes them.
            last: Whether the run has ended.
        """
        if self._driver is None:
            return
        keys = {name: group.keys for name, group in running.items()}
        self._driver.tell(outcome, keys, executor.slots, executor.device, self.why, last)
        if not self.why and not last:
            self.why = self._driver.reason_to_stop()
            if self.why:
                self._since = self._clock()
                self._note(
                    f"Stopping, since {self.why}: what runs ends at its next checkpoint, or "
                    f"after {PATIENCE:.0f} seconds without one."
                )
        if self.why:
            for group in running:
                self._store.pause_file(group).touch()

    def forget(self, running: Iterable[str]) -> None:
        """Takes the requests back from groups that have been ended otherwise."""
        for group in running:
            self._store.pause_file(group).unlink(missing_ok=True)

    @property
    def over(self) -> bool:
        """Whether running groups have had their time."""
        return bool(self.why) and self._clock() - self._since >= PATIENCE
