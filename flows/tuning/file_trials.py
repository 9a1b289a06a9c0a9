"""Trials as JSON lines, in the file of their search."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.pipeline.tracking.board import Metrics, View
from flows.pipeline.tracking.file_tracker import FileTracker, describe_node
from flows.tuning.trials import TrialRecord

__all__ = ["FileTrials"]

_TRIAL = "trial"


class FileTrials:
    """STORE/tracking/SEARCH.jsonl, with a line per trial that has ended.

    The file holds all trials of the studies it names, also those that another search has evaluated.
    """

    def __init__(self, root: Path | str) -> None:
        """Takes the store's folder; nothing is written before a search is opened."""
        self._tracker = FileTracker(root)

    def open(self, name: str, tags: Mapping[str, str], params: Mapping[str, Any]) -> None:
        """Opens the file of a search, see `Trials.open`.

        Raises:
            TrackingError: the file cannot be used, or another process is running this search.
            ValueError: the name is none for a search.
        """
        self._tracker.open(name, tags, params)

    def recorded(self, study: str) -> set[int]:
        """Numbers of the trials of a study that have a line."""
        events = self._tracker.file.newest()
        return {
            int(event["number"])
            for event in events
            if event.get("event") == _TRIAL and event.get("study") == study
        }

    def log_trial(self, trial: TrialRecord) -> None:
        """Records a trial that has ended.

        Raises:
            TrackingError: the file cannot be written.
        """
        node = trial.node
        content = {
            "study": trial.study,
            "number": trial.number,
            "state": trial.state,
            "drawn": dict(trial.parameters),
            "loss": trial.loss,
            "on_the_way": {
                str(percent): loss for percent, loss in trial.intermediate_losses.items()
            },
            "node": None if node is None else describe_node(node) | {"key": node.key},
            "reason": trial.reason,
        }
        self._tracker.file.write(_TRIAL, f"{trial.study}/{trial.number}", content)

    def show(self, views: Sequence[View]) -> str:
        """A file is looked at with other tools."""
        return ""

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Records how the search ended, see `Trials.close`.

        Raises:
            TrackingError: the file cannot be written.
        """
        self._tracker.close(status, files, metrics)
