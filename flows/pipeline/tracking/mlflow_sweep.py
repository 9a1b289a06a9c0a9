"""The parent run of a sweep in MLflow."""

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from flows.pipeline.plan import Plan
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_run import flat
from flows.pipeline.tracking.mlflow_writes import (
    DIGEST_LENGTH,
    log_anew,
    log_batches,
    log_datasets,
)
from flows.pipeline.tracking.redaction import without_secrets
from flows.pipeline.tracking.sweep_lock import check_sweep_name, hold_sweep
from flows.pipeline.tracking.tracker import Metrics

__all__ = ["MlflowSweep"]


class MlflowSweep:
    """A run that unfolds into those of its nodes. No other process may have it open.

    Attributes:
        name: Name of the sweep; empty before the first is opened.
        run_id: Of the parent run; None while none is open.
    """

    def __init__(self, experiment: MlflowExperiment) -> None:
        """Nothing is open yet."""
        self.name = ""
        self.run_id: str | None = None
        self._experiment = experiment
        self._lock = ExitStack()
        self._datasets: dict[tuple[str, str], Mapping[str, Any]] = {}

    @property
    def child_tags(self) -> dict[str, str]:
        """Tags of the runs below this one."""
        tags = {"sweep": self.name}
        return tags if self.run_id is None else tags | {"mlflow.parentRunId": self.run_id}

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Opens the parent run; that of an earlier sweep of this name is continued.

        Args:
            name: Name of the sweep: letters, digits, `_`, `-`, `.`.
            tags: Tags of the parent run.
            params: Parameters; those the parent run has with another value stay as they were.
            plan: Its numbers of nodes become parameters.

        Raises:
            TrackingError: MLflow cannot be used, or another process is running this sweep.
            ValueError: the name holds other characters.
        """
        check_sweep_name(name)
        # Whoever looks whether this sweep's lock is held is alone, too, and does not meet us here.
        with self._experiment.writing(), ExitStack() as held:
            held.enter_context(hold_sweep(self._experiment.root, name))
            self.run_id = self._parent(name, dict(tags or {}), dict(params or {}), plan)
            self._lock = held.pop_all()  # an error above gives it back
        self.name = name

    def _parent(
        self, name: str, tags: dict[str, str], params: dict[str, Any], plan: Plan | None
    ) -> str:
        experiment, client = self._experiment, self._experiment.client
        if plan is not None:
            params |= {f"nodes.{component}": n for component, n in plan.counts().items()}
        tags = experiment.common | tags | {"role": "sweep", "sweep": name}
        tags = {key: without_secrets(text) for key, text in tags.items()}
        known: Mapping[str, str] = {}
        run = next(experiment.search(f"tags.role = 'sweep' and tags.sweep = '{name}'"), None)
        if run is None:
            run = client.create_run(experiment.id, run_name=name, tags=tags)
        else:
            known = run.data.params
            client.update_run(run.info.run_id, status="RUNNING")
            log_batches(client, run.info.run_id, tags=tags)
        new = {key: value for key, value in flat(params).items() if key not in known}
        log_batches(client, run.info.run_id, params=new)
        return str(run.info.run_id)

    def add_datasets(self, datasets: Iterable[Mapping[str, Any]]) -> None:
        """Notes data sets that nodes have read; `close` names them as the sweep's own.

        Args:
            datasets: Per data set its `name`, `digest` and `source`.
        """
        for data in datasets:
            self._datasets[str(data["name"]), str(data["digest"])[:DIGEST_LENGTH]] = data

    def add_to_note(self, text: str) -> None:
        """Adds a paragraph to the note of the parent run, if one is open.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        if self.run_id is None:
            return
        client, tag = self._experiment.client, "mlflow.note.content"
        with self._experiment.writing():
            note = client.get_run(self.run_id).data.tags.get(tag, "")
            if text not in note:
                client.set_tag(self.run_id, tag, f"{note}\n\n{text}".strip())

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the parent run; does nothing if none is open.

        Args:
            status: FINISHED, FAILED or KILLED.
            files: Files to keep with it, under `report/`.
            metrics: Per name (step, value) pairs; a single number has step 0.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        if self.run_id is None:
            return
        client = self._experiment.client
        with self._lock, self._experiment.as_tracking_errors():
            for file in files:
                client.log_artifact(self.run_id, str(file), "report")
            log_anew(client, self.run_id, metrics or {})
            run = client.get_run(self.run_id)
            known = {(data.dataset.name, data.dataset.digest) for data in run.inputs.dataset_inputs}
            new = [data for key, data in self._datasets.items() if key not in known]
            log_datasets(client, self.run_id, new)
            begun = run.info.start_time or 0
            # Not before the start, even if the clock was set back.
            end = max(begun, int(1000 * time.time()))
            client.set_terminated(self.run_id, status, end_time=end)
            self.run_id = None
