"""When a run stops by itself: after so many hours, or at a time of day."""

import time
from collections.abc import Callable
from datetime import datetime, timedelta

__all__ = ["Limit"]

_HOUR = 3600.0


class Limit:
    """A limit that begins to count when it is made."""

    def __init__(
        self,
        hours: float | None = None,
        until: str | None = None,
        *,
        now: Callable[[], datetime] = datetime.now,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Takes what is wanted; without either there is no limit.

        Args:
            hours: After which to stop. A clock that is set changes nothing.
            until: Local time of day at which to stop, "HH:MM"; the next one from now.
            now: The time of day.
            clock: Seconds from any moment.
        """
        self._hours, self._now, self._clock = hours, now, clock
        self._begun = clock()
        self._until: datetime | None = None
        if until is not None:
            hour, minute = map(int, until.split(":"))
            at = now().replace(hour=hour, minute=minute, second=0, microsecond=0)
            self._until = at if at > now() else at + timedelta(days=1)

    def __str__(self) -> str:
        """What the limit is, as words; empty if there is none."""
        words = [] if self._hours is None else [f"after {self._hours:g} hours"]
        words += [] if self._until is None else [f"at {self._until:%H:%M on %Y-%m-%d}"]
        return " or ".join(words)

    @property
    def sentence(self) -> str:
        """The same in a sentence."""
        return f"It stops {self}, resumably." if str(self) else ""

    def reached(self) -> str:
        """Why to stop now, as a clause; empty as long as there is no reason."""
        if self._hours is not None and self._clock() - self._begun >= self._hours * _HOUR:
            return f"max_hours={self._hours:g} are over"
        if self._until is not None and self._now() >= self._until:
            return f"it is {self._until:%H:%M}"
        return ""
