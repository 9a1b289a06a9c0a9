"""A tracker that also keeps a flat table of results."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.pipeline.plan import Node, Plan
from flows.pipeline.tracking.board import Board, Entry, Metrics, View
from flows.pipeline.tracking.tracker import Tracker

__all__ = ["BoardTracker"]


class BoardTracker:
    """Records the row of every node that has one, as soon as the node is finished."""

    def __init__(self, tracker: Tracker, board: Board) -> None:
        """Takes what records and what says the rows."""
        self._tracker, self._board = tracker, board

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Begins the record of a sweep and prepares the looks at it, see `Tracker.open`."""
        self._tracker.open(name, tags, params, plan)
        self._tracker.prepare(self._board.views())

    def log_node(self, node: Node, folder: Path) -> None:
        """Records a node and its row; if the row is refused, both are asked for again.

        Raises:
            TrackingError: the record cannot be written.
            DamagedFileError: a file of the artifact is damaged.
        """
        self._tracker.log_node(node, folder)
        entry = self._board.entry(node, folder)
        if entry is not None:
            self._tracker.log_entry(entry)

    def log_entry(self, entry: Entry) -> None:
        """Records a row, see `Tracker.log_entry`."""
        self._tracker.log_entry(entry)

    def prepare(self, views: Sequence[View]) -> None:
        """Prepares looks, see `Tracker.prepare`."""
        self._tracker.prepare(views)

    def log_failure(self, node: Node, reason: str) -> None:
        """Records a failed node, see `Tracker.log_failure`."""
        self._tracker.log_failure(node, reason)

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the record, see `Tracker.close`."""
        self._tracker.close(status, files, metrics)
