"""Trials in MLflow: every one is a run below the run of the search.

A trial that was computed in this search is the run of its node. Others get a small run with the
settings, the intermediate losses and the state: those that were pruned or failed, and those whose
result was there before and has its run below the sweep that made it. Both are found by the tags
`study`, `trial` and `state`.
"""

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from flows.pipeline.tracking.mlflow_run import flat
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import Metrics
from flows.tuning.trials import TrialRecord

__all__ = ["MlflowTrials"]

_STATUS = {"COMPLETE": "FINISHED", "PRUNED": "KILLED", "FAIL": "FAILED", "INTERRUPTED": "KILLED"}


class MlflowTrials:
    """The record of a search in MLflow.

    Attributes:
        experiment: Holds all runs.
        sweep: The run of the search.
    """

    def __init__(self, root: Path | str, source: str = "") -> None:
        """Opens MLflow, see `MlflowTracker`.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self._nodes = MlflowTracker(root, source)
        self.experiment = self._nodes.experiment
        self.sweep = self._nodes.sweep

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        """Opens the run of a search, see `Trials.open`.

        Raises:
            TrackingError: MLflow cannot be used, or another process is running this search.
            ValueError: the name is none for a search.
        """
        self._nodes.open(name, tags, params)

    def recorded(self, study: str) -> set[int]:
        """Numbers of the trials of a study whose runs are whole.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        whole = f"attributes.status != 'RUNNING' and tags.study = '{study}'"
        with self.experiment.as_tracking_errors():
            return {int(run.data.tags["trial"]) for run in self.experiment.search(whole)}

    def log_trial(self, trial: TrialRecord) -> None:
        """Records a trial.

        Args:
            trial: One that has ended and is not recorded yet.

        Raises:
            TrackingError: MLflow cannot be used. Study and artifact are not touched.
        """
        tags = {"study": trial.study, "trial": str(trial.number), "state": trial.state}
        if trial.loss is not None:
            tags["validation_loss"] = repr(trial.loss)
        made = trial.node is not None and trial.folder is not None
        if not (made and self._nodes.record(trial.node, trial.folder, tags)):
            self._record_small(trial, tags)

    def _record_small(self, trial: TrialRecord, tags: Mapping[str, str]) -> None:
        """Writes the run of a trial that is not the run of its node."""
        name = f"{trial.study.rpartition('/')[0]}/trial{trial.number}"
        tags = dict(tags) | self.sweep.child_tags | {"role": "trial"}
        params = {f"drawn.{name}": value for name, value in trial.parameters.items()}
        if trial.node is not None:
            name = trial.node.name
            tags |= flat(dict(trial.node.tags)) | {"key": trial.node.key}
            params |= dict(trial.node.config)
        if trial.reason:
            tags["error"] = trial.reason
        now = int(1000 * time.time())
        metrics = [
            ("model/validation_loss_on_the_way", loss, now, percent)
            for percent, loss in trial.intermediate_losses.items()
        ]
        if trial.loss is not None:
            metrics.append(("validation_loss", trial.loss, now, 0))
        with self.experiment.writing():
            self.experiment.write_run(
                name, tags, _STATUS[trial.state], params=flat(params), metrics=metrics
            )

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the run of the search, see `Trials.close`.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self._nodes.close(status, files, metrics)
