"""Trials in MLflow: every one is a run below the run of the search.

A trial that was computed in this search is the run of its node. Others get a small run with the
settings, the intermediate losses and the state: those that were pruned or failed, and those whose
result was there before and has its run below the sweep that made it. Both are found by the tags
`study`, `trial` and `state`.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.pipeline.tracking.board import Metrics, View
from flows.pipeline.tracking.mlflow_run import flat
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.mlflow_ui import sweep_address
from flows.pipeline.tracking.mlflow_writes import log_batches
from flows.tuning.trials import TrialRecord

__all__ = ["MlflowTrials"]

# To be stopped early is a result of a trial; MLflow has no word for it, so the tag `state` says it.
_STATUS = {"COMPLETE": "FINISHED", "PRUNED": "FINISHED", "FAIL": "FAILED", "INTERRUPTED": "KILLED"}


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
        node, folder = trial.node, trial.folder
        if node is None or folder is None or not self._nodes.record(node, folder, tags):
            self._record_small(trial, tags)
            return
        # Over the percent of the budget, as of trials that were stopped: all in one chart.
        with self.experiment.writing():
            log_batches(self.experiment.client, self._nodes.run_of(node), _on_the_way(trial))

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
        metrics = _on_the_way(trial)
        if trial.loss is not None:
            metrics.append(("validation_loss", trial.loss, int(1000 * time.time()), 0))
        with self.experiment.writing():
            self.experiment.write_run(
                name, tags, _STATUS[trial.state], params=flat(params), metrics=metrics
            )

    def show(self, views: Sequence[View]) -> str:
        """Saves views on the page of the runs, see `Trials.show`.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self._nodes.prepare(views)
        return sweep_address(self.experiment, self.sweep.run_id)

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the run of the search, see `Trials.close`.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self._nodes.close(status, files, metrics)


def _on_the_way(trial: TrialRecord) -> list[tuple[str, float, int, int]]:
    now = int(1000 * time.time())
    name = "model/validation_loss_on_the_way"
    return [(name, loss, now, percent) for percent, loss in trial.intermediate_losses.items()]
