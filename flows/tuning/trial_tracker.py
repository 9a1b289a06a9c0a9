"""Trials in MLflow: every one is a run below the run of the search.

A trial that was computed in this search is the run of its node. Others have no node run of their
own: those that were pruned or failed, and those whose result was there before and has its run below
the sweep that made it. They get a small run with the settings, the losses on the way and the state.
Either is found by the tags `study`, `trial` and `state`.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from flows.pipeline.plan import Node
from flows.pipeline.tracking.mlflow_run import flat
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.mlflow_writes import log_batches

__all__ = ["TrialRecord", "TrialTracker", "Trials"]

_STATUS = {"COMPLETE": "FINISHED", "PRUNED": "KILLED", "FAIL": "FAILED", "INTERRUPTED": "KILLED"}


@dataclass(frozen=True)
class TrialRecord:
    """What is remembered of a trial.

    Attributes:
        study: Name of the study.
        number: Of the trial in it.
        state: COMPLETE, PRUNED, FAIL or INTERRUPTED.
        drawn: Parameters as Optuna drew them.
        loss: Held-out loss of a complete trial.
        on_the_way: Held-out losses by percent of the budget.
        node: What it computed; None if no configuration came of it.
        folder: The node's finished artifact, if there is one.
        reason: Why it failed.
    """

    study: str
    number: int
    state: str
    drawn: Mapping[str, Any]
    loss: float | None
    on_the_way: Mapping[int, float]
    node: Node | None
    folder: Path | None
    reason: str = ""

    @property
    def tags(self) -> dict[str, str]:
        """By which the trial is found."""
        found = {"study": self.study, "trial": str(self.number), "state": self.state}
        return found if self.loss is None else found | {"validation_loss": repr(self.loss)}


class Trials(Protocol):
    """Whoever remembers trials for people."""

    def recorded(self, study: str) -> set[int]:
        """Numbers of the trials that need not be told again."""

    def log_trial(self, trial: TrialRecord) -> None:
        """Remembers a trial that has ended."""


class TrialTracker(MlflowTracker):
    """The tracker of a search."""

    def recorded(self, study: str) -> set[int]:
        """Numbers of the trials of a study whose runs are whole.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self._speaking():
            found = self._search(f"attributes.status != 'RUNNING' and tags.study = '{study}'")
            return {int(run.data.tags["trial"]) for run in found}

    def log_trial(self, trial: TrialRecord) -> None:
        """Records a trial.

        Args:
            trial: One that has ended and is not recorded yet.

        Raises:
            TrackingError: MLflow cannot be used. Study and artifact are not touched.
        """
        with self._speaking(), self._alone():
            made = trial.node is not None and trial.folder is not None
            if made and self._known(trial.node.key)[0] is None:
                mark = {f"sweep.{self._sweep_name}": "computed"}
                self._record(trial.node, trial.folder, trial.tags | mark)
            else:
                self._record_small(trial)

    def _record_small(self, trial: TrialRecord) -> None:
        name = f"{trial.study.rpartition('/')[0]}/trial{trial.number}"
        tags = self._common | trial.tags | {"role": "trial", "sweep": self._sweep_name}
        params = {f"drawn.{name}": value for name, value in trial.drawn.items()}
        if trial.node is not None:
            name = trial.node.name
            tags |= flat(dict(trial.node.tags)) | {"key": trial.node.key}
            params |= dict(trial.node.config)
        if trial.reason:
            tags["error"] = trial.reason
        if self._sweep is not None:
            tags["mlflow.parentRunId"] = self._sweep
        run = self.client.create_run(self.experiment, run_name=name, tags=tags)
        now = int(1000 * time.time())
        metrics = [
            ("model/validation_loss_on_the_way", loss, now, percent)
            for percent, loss in trial.on_the_way.items()
        ]
        if trial.loss is not None:
            metrics.append(("validation_loss", trial.loss, now, 0))
        log_batches(self.client, run.info.run_id, metrics=metrics, params=flat(params))
        self.client.set_terminated(run.info.run_id, _STATUS[trial.state])

    def _close_leftovers(self) -> None:
        # Runs of trials are open for milliseconds only; a half-written one is written again.
        for run in self._search("attributes.status = 'RUNNING' and tags.study != ''"):
            self.client.delete_run(run.info.run_id)
        super()._close_leftovers()
