"""What the pipeline needs of a tracker, and one that records nothing."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from flows.pipeline.plan import Node, Plan
from flows.pipeline.tracking.board import Entry, Metrics, View

__all__ = ["Metrics", "NullTracker", "Tracker"]


class Tracker(Protocol):
    """Records a sweep for people. One process calls it, the driver.

    Every method raises TrackingError if the record cannot be written. No artifact depends on it:
    the driver goes on, and the next run of the sweep records what is missing.
    """

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Begins the record of a sweep, or continues that of an earlier sweep of the same name.

        Args:
            name: Name of the sweep: letters, digits, `_`, `-`, `.`.
            tags: What the sweep is found by.
            params: What it is over.
            plan: Its nodes, where they are known beforehand.

        Raises:
            TrackingError: also if another process is running this sweep.
            ValueError: the name holds other characters.
        """

    def log_node(self, node: Node, folder: Path) -> None:
        """Records a finished node with its artifact folder; adds nothing to one recorded before.

        Raises:
            DamagedFileError: a file of the artifact is damaged.
        """

    def log_failure(self, node: Node, reason: str) -> None:
        """Records a failed node with a traceback or a sentence."""

    def log_entry(self, entry: Entry) -> None:
        """Records a row of the flat table of results; reads none that is recorded already.

        Raises:
            DamagedFileError: a file that the row is read from is damaged.
        """

    def prepare(self, views: Sequence[View]) -> None:
        """Prepares looks at the runs, in place of earlier ones of the same keys."""

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the record; does nothing if none is open.

        Args:
            status: FINISHED, FAILED or KILLED.
            files: The report.
            metrics: The sweep's own numbers.
        """


class NullTracker:
    """Records nothing."""

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Does nothing."""

    def log_node(self, node: Node, folder: Path) -> None:
        """Does nothing."""

    def log_failure(self, node: Node, reason: str) -> None:
        """Does nothing."""

    def log_entry(self, entry: Entry) -> None:
        """Does nothing."""

    def prepare(self, views: Sequence[View]) -> None:
        """Does nothing."""

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Does nothing."""
