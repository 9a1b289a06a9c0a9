"""What a search needs of a tracker, and one that records nothing."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from flows.pipeline.plan import Node
from flows.pipeline.tracking.board import Metrics, View

__all__ = ["NullTrials", "TrialRecord", "Trials"]


@dataclass(frozen=True)
class TrialRecord:
    """What is recorded of a trial.

    Attributes:
        study: Name of the study.
        number: Of the trial in it.
        state: COMPLETE, PRUNED, FAIL or INTERRUPTED.
        parameters: As Optuna drew them.
        loss: Held-out loss of a complete trial.
        intermediate_losses: Held-out losses by percent of the budget.
        node: What it computed; None if no configuration came of it.
        folder: The node's finished artifact, if there is one.
        reason: Why it failed.
    """

    study: str
    number: int
    state: str
    parameters: Mapping[str, Any]
    loss: float | None
    intermediate_losses: Mapping[int, float]
    node: Node | None
    folder: Path | None
    reason: str = ""


class Trials(Protocol):
    """Records a search for people. One process calls it, the driver.

    Every method raises TrackingError if the record cannot be written. The studies hold everything:
    the search goes on, and the next run of it records what is missing.
    """

    def open(self, name: str, tags: Mapping[str, str], params: Mapping[str, Any]) -> None:
        """Begins the record of a search, or continues that of an earlier one of the same name.

        Args:
            name: Name of the search: letters, digits, `_`, `-`, `.`.
            tags: What it is found by.
            params: What it is over.

        Raises:
            TrackingError: also if another process is running this search.
            ValueError: the name holds other characters.
        """

    def recorded(self, study: str) -> set[int]:
        """Numbers of the trials of a study that are recorded already."""

    def log_trial(self, trial: TrialRecord) -> None:
        """Records a trial that has ended."""

    def show(self, views: Sequence[View]) -> str:
        """Prepares looks at the trials.

        Returns:
            Address of the search's record; empty if it has none.
        """

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the record; does nothing if none is open.

        Args:
            status: FINISHED, FAILED or KILLED.
            files: What the search has written.
            metrics: The search's own numbers.
        """


class NullTrials:
    """Records nothing."""

    def open(self, name: str, tags: Mapping[str, str], params: Mapping[str, Any]) -> None:
        """Does nothing."""

    def recorded(self, study: str) -> set[int]:
        """None."""
        return set()

    def log_trial(self, trial: TrialRecord) -> None:
        """Does nothing."""

    def show(self, views: Sequence[View]) -> str:
        """Nothing is recorded."""
        return ""

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Does nothing."""
