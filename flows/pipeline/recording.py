"""Tells the tracker about finished and failed nodes, and asks one that refuses again later."""

import time
from collections.abc import Callable

from components.core.integrity import DamagedFileError
from flows.pipeline.artifacts import Artifacts
from flows.pipeline.errors import TrackingError
from flows.pipeline.plan import Node
from flows.pipeline.tracking.tracker import Tracker

__all__ = ["Recorder"]

_PAUSE = 60.0  # seconds before a tracker that refused is asked again


class Recorder:
    """Records the nodes of a run.

    Attributes:
        waiting: Nodes that the tracker has refused, with the reason of the failed ones.
        refusal: Why; empty if it lacks none.
        unreadable: What is wrong with artifacts that could not be read, a sentence by key; for the
            caller to empty.
    """

    def __init__(self, tracker: Tracker, store: Artifacts, note: Callable[[str], None]) -> None:
        """Takes the open tracker, the artifacts and what shows a message."""
        self._tracker, self._store, self._note = tracker, store, note
        self._closed_until = float("-inf")
        self._warned = False
        self.waiting: list[tuple[Node, str | None]] = []
        self.refusal = ""
        self.unreadable: dict[str, str] = {}

    def record(self, node: Node, reason: str | None = None) -> None:
        """Records a finished node, or a failed one with its reason."""
        if time.monotonic() < self._closed_until:
            self.waiting.append((node, reason))
            return
        try:
            if reason is None:
                self._tracker.log_node(node, self._store.path(node.key))
            else:
                self._tracker.log_failure(node, reason)
        except DamagedFileError as error:  # no fault of the tracker
            self.unreadable[node.key] = error.sentence
        except TrackingError as error:
            if not self._warned:
                self._note(f"{error} The work goes on.")
                self._warned = True
            self.refusal = str(error)
            self.waiting.append((node, reason))
            self._closed_until = time.monotonic() + _PAUSE

    def retry(self, *, last: bool = False) -> None:
        """Records what waits, if the tracker has been left alone for long enough.

        Args:
            last: Whether to do it in any case.
        """
        if last:
            self._closed_until = float("-inf")
        if not self.waiting or time.monotonic() < self._closed_until:
            return
        again, self.waiting = self.waiting, []
        self.refusal = ""
        for node, reason in again:
            self.record(node, reason)
