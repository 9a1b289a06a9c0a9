"""A clean stop: nothing new begins, and what runs ends at its next checkpoint."""

import time
from collections.abc import Callable, Iterable

from flows.pipeline.driver import Driver
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

    def look(self, running: Iterable[str]) -> None:
        """Looks for a reason, and asks running groups to end at their next checkpoint.

        Args:
            running: Their names.
        """
        if not self.why and self._driver is not None:
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
