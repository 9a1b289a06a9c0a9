"""What MLflow remembers: a parent run per sweep, below it one run per node.

The driver alone writes, after a node's artifact is complete on disk. A run that a killed driver
left half-written is closed as KILLED at the next start and the node gets a whole one. MLflow is
imported when a tracker is opened, not before: that takes more than a second.
"""

import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from flows.pipeline.errors import TrackingError
from flows.pipeline.files import locked
from flows.pipeline.plan import Node, Plan
from flows.pipeline.tracking.mlflow_run import flat, link_tree, read_content
from flows.pipeline.tracking.mlflow_setup import (
    EXPERIMENT,
    import_mlflow,
    make_database,
    origin,
    without_password,
)
from flows.pipeline.tracking.mlflow_writes import log_batches, log_datasets

__all__ = ["MlflowTracker"]

_MANY = 1000  # runs per page of a search
_TAG_LENGTH = 5000


class MlflowTracker:
    """One MLflow experiment, in a database of our own or wherever MLFLOW_TRACKING_URI says."""

    def __init__(self, root: Path | str, experiment: str = EXPERIMENT, source: str = "") -> None:
        """Opens the tracker; makes database and experiment if there are none.

        Args:
            root: Folder of the store. By default the database is `mlflow.db` in it.
            experiment: Name of the MLflow experiment.
            source: What runs, for the column "source" of the UI.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self.root = Path(root).absolute()
        self.uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self.root}/mlflow.db"
        own = not os.environ.get("MLFLOW_TRACKING_URI")
        self._sweep: str | None = None
        self._sweep_name = ""
        self._finished: dict[str, tuple[str, Mapping[str, str]]] = {}
        self._closing = ExitStack()
        self._common = {"mlflow.source.name": source, "mlflow.source.type": "LOCAL"}
        self._common |= origin()
        with self._speaking():
            (self.root / "locks").mkdir(parents=True, exist_ok=True)
            mlflow = import_mlflow()
            with self._alone():
                if own:
                    make_database(self.root)
                self.client = mlflow.MlflowClient(tracking_uri=self.uri)
                self.experiment = self._open_experiment(experiment)

    # Sweeps

    def open_sweep(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> str:
        """Opens the parent run of a sweep; a sweep of the same name is continued.

        Args:
            name: Name of the sweep: letters, digits, `_`, `-`, `.`.
            tags: Tags of the parent run.
            params: Parameters; those the parent run has with another value stay as they were.
            plan: The plan; its size becomes parameters and its nodes are looked up at once.

        Returns:
            The id of the parent run.

        Raises:
            TrackingError: MLflow cannot be used, or another process is running this sweep.
            ValueError: the name holds other characters.
        """
        if not re.fullmatch(r"[\w.-]+", name, flags=re.ASCII):
            raise ValueError(
                f"The sweep name {name!r} may hold letters, digits, '_', '-' and '.' only."
            )
        with self._speaking():
            lock = locked(self.root / "locks" / f"sweep-{name}.lock", wait=False)
            if not self._closing.enter_context(lock):
                raise TrackingError(
                    f"Another process is running the sweep {name!r}: "
                    "wait for it, stop it, or give this sweep another name."
                )
            with self._alone():
                self._close_leftovers()
                self._sweep = self._parent(name, dict(tags or {}), dict(params or {}), plan)
            self._sweep_name = name
            wanted = None if plan is None else {node.key for node in plan}
            for run in self._search("attributes.status = 'FINISHED' and tags.role = 'node'"):
                key = run.data.tags.get("key", "")
                if wanted is None or key in wanted:
                    self._finished[key] = (run.info.run_id, run.data.tags)
        return self._sweep

    def close_sweep(
        self,
        status: str,
        report_files: Iterable[Path] = (),
        metrics: Mapping[str, Sequence[tuple[int, float]]] | None = None,
    ) -> None:
        """Ends the parent run.

        Args:
            status: FINISHED, FAILED or KILLED.
            report_files: Files to keep with it, under `report/`.
            metrics: Per name (step, value) pairs; a single number has step 0.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        if self._sweep is None:
            return
        with self._closing, self._speaking():
            for file in report_files:
                self.client.log_artifact(self._sweep, str(file), "report")
            now = int(time.time() * 1000)
            log_batches(
                self.client,
                self._sweep,
                metrics=[
                    (name, float(value), now, step)
                    for name, points in (metrics or {}).items()
                    for step, value in points
                ],
            )
            self.client.set_terminated(self._sweep, status)
            self._sweep = None

    def _parent(
        self, name: str, tags: dict[str, str], params: dict[str, Any], plan: Plan | None
    ) -> str:
        if plan is not None:
            params |= {f"nodes.{component}": n for component, n in plan.counts().items()}
        found = self._search(f"tags.role = 'sweep' and tags.sweep = '{name}'")
        tags |= {"role": "sweep", "sweep": name}
        known: Mapping[str, str] = {}
        run = next(found, None)
        if run is None:
            run = self.client.create_run(self.experiment, run_name=name, tags=self._common | tags)
        else:
            known = run.data.params
            self.client.update_run(run.info.run_id, status="RUNNING")
            log_batches(self.client, run.info.run_id, tags=self._common | tags)
        new = {key: value for key, value in flat(params).items() if key not in known}
        log_batches(self.client, run.info.run_id, params=new)
        return str(run.info.run_id)

    def _close_leftovers(self) -> None:
        # Node runs are open for milliseconds only, by somebody who holds the lock we hold now.
        for run in self._search("attributes.status = 'RUNNING' and tags.role = 'node'"):
            self.client.set_terminated(run.info.run_id, "KILLED")

    # Nodes

    def log_node(self, node: Node, folder: Path) -> None:
        """Records a finished node, unless a finished run of the same key is there already.

        Args:
            node: The node.
            folder: Its artifact.

        Raises:
            TrackingError: MLflow cannot be used. The artifact is not touched.
        """
        with self._speaking(), self._alone():
            mark = f"sweep.{self._sweep_name}"
            run_id, known = self._known(node.key)
            if run_id is not None:
                if mark not in known:
                    self.client.set_tag(run_id, mark, "reused")
                return
            self._record(node, folder, {mark: "computed"})

    def _record(self, node: Node, folder: Path, further: Mapping[str, str]) -> None:
        """Writes the run of a node that has none."""
        content = read_content(folder)
        started, ended = (int(1000 * content.record[name]) for name in ("started", "finished"))
        tags = flat(content.tags) | self._tags(node) | further
        run = self.client.create_run(
            self.experiment, start_time=started, run_name=node.name, tags=tags
        )
        run_id = run.info.run_id
        log_batches(self.client, run_id, params=flat(dict(node.config)) | content.params)
        log_batches(self.client, run_id, metrics=content.metrics)
        log_datasets(self.client, run_id, content.datasets)
        self._log_artifacts(run_id, run.info.artifact_uri, folder)
        self.client.set_terminated(run_id, "FINISHED", end_time=ended)
        self._finished[node.key] = (run_id, tags)

    def log_failure(self, node: Node, reason: str) -> None:
        """Records a failed node with its traceback.

        Args:
            node: The node.
            reason: The traceback, or one sentence.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self._speaking(), self._alone():
            last = (reason.strip() or "no reason given").splitlines()[-1]
            tags = self._tags(node) | {f"sweep.{self._sweep_name}": "failed"}
            tags |= {"error": last[:_TAG_LENGTH]}
            run = self.client.create_run(self.experiment, run_name=node.name, tags=tags)
            log_batches(self.client, run.info.run_id, params=flat(dict(node.config)))
            self.client.log_text(run.info.run_id, reason, "traceback.txt")
            self.client.set_terminated(run.info.run_id, "FAILED")

    def _known(self, key: str) -> tuple[str | None, Mapping[str, str]]:
        if key in self._finished:
            return self._finished[key]
        # A driver of another sweep may have recorded it since this one started.
        found = f"attributes.status = 'FINISHED' and tags.key = '{key}' and tags.role = 'node'"
        run = next(self._search(found), None)
        return (None, {}) if run is None else (run.info.run_id, run.data.tags)

    def _tags(self, node: Node) -> dict[str, str]:
        note = f"**{node.name}**, a node of `{node.component}`"
        if node.inputs:
            note += " made from " + ", ".join(f"{i.name} ({r})" for r, i in node.inputs.items())
        tags = self._common | flat(dict(node.tags))
        tags |= {"role": "node", "component": node.component, "key": node.key}
        tags |= {"version": str(node.version), "sweep": self._sweep_name}
        tags |= {"mlflow.note.content": f"{note}."[:_TAG_LENGTH]}
        if self._sweep is not None:
            tags["mlflow.parentRunId"] = self._sweep
        return tags

    def _log_artifacts(self, run_id: str, uri: str, folder: Path) -> None:
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        if is_local_uri(uri):
            link_tree(folder, Path(local_file_uri_to_path(uri)))
        else:
            self.client.log_artifacts(run_id, str(folder))

    # MLflow

    def _open_experiment(self, name: str) -> str:
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            # A server decides by itself where its artifacts lie.
            remote = self.uri.partition(":")[0] in ("http", "https", "databricks")
            place = None if remote else (self.root / "artifacts").as_uri()
            return str(self.client.create_experiment(name, artifact_location=place))
        if experiment.lifecycle_stage != "active":
            self.client.restore_experiment(experiment.experiment_id)
        return str(experiment.experiment_id)

    def _search(self, text: str) -> Iterator[Any]:
        token = None
        while True:
            page = self.client.search_runs(
                [self.experiment], text, max_results=_MANY, page_token=token
            )
            yield from page
            token = page.token
            if not token:
                return

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """One driver on this folder at a time: no half-made database, no second run of a key."""
        with locked(self.root / "locks" / "tracker.lock"):
            yield

    @contextmanager
    def _speaking(self) -> Iterator[None]:
        """Turns whatever MLflow or its database raises into one sentence."""
        try:
            yield
        except TrackingError:
            raise
        except Exception as error:
            line = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
            line = without_password(line)[:300].rstrip(".")
            raise TrackingError(
                f"MLflow at {without_password(self.uri)} refused ({line}); "
                "artifacts on disk are safe: repair it, or set MLFLOW_TRACKING_URI to another "
                "one, and give the same command again."
            ) from error
