"""The MLflow experiment that all sweeps share: how its runs are found and written.

MLflow is imported when an experiment is opened, not before: that takes more than a second.
"""

import hashlib
import socket
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError
from flows.pipeline.errors import TrackingError
from flows.pipeline.locks import locked
from flows.pipeline.tracking.board import View
from flows.pipeline.tracking.mlflow_address import StoreAddress, path_of
from flows.pipeline.tracking.mlflow_errors import refusal
from flows.pipeline.tracking.mlflow_leftovers import close_leftovers
from flows.pipeline.tracking.mlflow_moves import follow_move, former_place
from flows.pipeline.tracking.mlflow_run import link_tree
from flows.pipeline.tracking.mlflow_setup import (
    ABOUT,
    EXPERIMENT,
    import_mlflow,
    make_database,
    source_tags,
)
from flows.pipeline.tracking.mlflow_views import view_tags
from flows.pipeline.tracking.mlflow_writes import log_batches, log_datasets
from flows.pipeline.tracking.redaction import without_secrets

__all__ = ["MlflowExperiment"]

_MANY = 1000  # runs per page of a search
_STORE = "store"  # tag of runs in an MLflow that several stores may use


class MlflowExperiment:
    """One MLflow experiment, in a database of our own or at the address in MLFLOW_TRACKING_URI.

    Attributes:
        root: Folder of the store.
        address: Of the store and of MLflow.
        client: An MlflowClient, for whatever has no method here.
        id: The experiment's id.
        common: Tags of every run: user, commit and program.
    """

    def __init__(self, root: Path | str, source: str = "", name: str = EXPERIMENT) -> None:
        """Opens the experiment; makes database and experiment if there are none.

        A store that was moved is followed, and what killed processes left open is closed.

        Args:
            root: Folder of the store. By default the database is `mlflow.db` in it.
            source: What runs, for the column "source" of the UI.
            name: Name of the experiment.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self._interrupted = False  # whether a run may have been left half-written by us
        self.address = StoreAddress(root)
        self.root = self.address.root
        self.common = {"mlflow.source.name": source, "mlflow.source.type": "LOCAL"} | source_tags()
        if not self.address.own:
            self.common |= {_STORE: self._signature()}
        with self.as_tracking_errors():
            (self.root / "locks").mkdir(parents=True, exist_ok=True)
            mlflow = import_mlflow()
            with self._alone():
                former = None
                if self.address.own:
                    make_database(self.address)
                    # MLflow would try for minutes to open a database that is damaged.
                    former = former_place(self.address.database)
                self.client = mlflow.MlflowClient(tracking_uri=self.address.tracking)
                self.id = self._open(name)
                # Only now is the database known to be one that this MLflow writes.
                moved = follow_move(self.address, former)
                if moved:
                    print(moved, file=sys.stderr)
                close_leftovers(self)

    def _open(self, name: str) -> str:
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            place = self.address.artifacts  # a server decides by itself where its artifacts lie
            if place is not None:
                (self.root / "artifacts").mkdir(exist_ok=True)
            about = ABOUT.get(name, {})
            return str(self.client.create_experiment(name, artifact_location=place, tags=about))
        if not self.address.own:
            self._check_place(experiment.artifact_location)
        if experiment.lifecycle_stage != "active":
            self.client.restore_experiment(experiment.experiment_id)
        for tag, text in ABOUT.get(name, {}).items():
            if tag not in experiment.tags:  # one that people have changed stays
                self.client.set_experiment_tag(experiment.experiment_id, tag, text)
        return str(experiment.experiment_id)

    def _check_place(self, location: str) -> None:
        """A database of the user's keeps the place of the store that used it first."""
        place = path_of(location)
        if self.address.artifacts is not None and place is not None and not place.exists():
            raise TrackingError(
                f"MLflow at {without_secrets(self.address.tracking)} keeps the files of all runs "
                f"in {place}, which is gone, perhaps moved: bring it back, or set "
                "MLFLOW_TRACKING_URI to another database, and give the same command again."
            )

    def entity(self) -> Any:
        """The experiment as MLflow knows it.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self.as_tracking_errors():
            return self.client.get_experiment(self.id)

    def prepare(self, views: Iterable[View]) -> None:
        """Saves views that the experiment's page offers, in place of earlier ones of these keys.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self.writing():
            known = self.client.get_experiment(self.id).tags
            for tag, text in view_tags(views, known).items():
                self.client.set_experiment_tag(self.id, tag, text)

    def owns(self, tags: Mapping[str, str]) -> bool:
        """Whether a run was made by this store, whose locks say which processes live.

        Args:
            tags: Of the run. In our own database all runs are the store's.
        """
        return self.address.own or tags.get(_STORE) == self._signature()

    def _signature(self) -> str:
        """Tells this store from others that use the same MLflow."""
        return hashlib.sha256(f"{socket.gethostname()} {self.root}".encode()).hexdigest()[:16]

    def search(self, text: str, *, deleted: bool = False) -> Iterator[Any]:
        """The runs that match a filter in MLflow's language, the newest first.

        Args:
            text: The filter.
            deleted: Whether runs that were deleted, and can still be restored, are among them.
        """
        token, view = None, 3 if deleted else 1  # mlflow.entities.ViewType.ALL, ACTIVE_ONLY
        while True:
            page = self.client.search_runs([self.id], text, view, _MANY, page_token=token)
            yield from page
            token = page.token
            if not token:
                return

    def write_run(
        self,
        name: str,
        tags: Mapping[str, str],
        status: str,
        *,
        params: Mapping[str, str],
        metrics: Iterable[tuple[str, float, int, int]] = (),
        datasets: Sequence[Mapping[str, Any]] = (),
        folder: Path | None = None,
        texts: Mapping[str, str] | None = None,
        times: tuple[int, int] | None = None,
    ) -> str:
        """Writes a run from its creation to its end; the caller holds `writing()`.

        Args:
            name: Of the run.
            tags: Beside those of every run.
            status: FINISHED, FAILED or KILLED.
            params: Parameters by name.
            metrics: (name, value, milliseconds since 1970, step).
            datasets: Data sets that were read, each with `name`, `digest` and `source`.
            folder: Files to keep with the run.
            texts: Content of further files by name.
            times: Start and end in milliseconds since 1970; now by default.

        Returns:
            The run's id.
        """
        start, end = times or (None, None)
        tags = {name: without_secrets(text) for name, text in (self.common | dict(tags)).items()}
        run = self.client.create_run(self.id, start_time=start, run_name=name, tags=tags)
        run_id = str(run.info.run_id)
        log_batches(self.client, run_id, metrics=metrics, params=params)
        log_datasets(self.client, run_id, datasets)
        if folder is not None:
            self._keep(run_id, run.info.artifact_uri, folder)
        for file, text in (texts or {}).items():
            self.client.log_text(run_id, without_secrets(text), file)
        self.client.set_terminated(run_id, status, end_time=end)
        return run_id

    def keep_again(self, run_id: str, folder: Path) -> None:
        """Keeps the files of a folder in place of those that a run has; holds `writing()` itself.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self.writing():
            self._keep(run_id, self.client.get_run(run_id).info.artifact_uri, folder)

    def _keep(self, run_id: str, uri: str, folder: Path) -> None:
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        if is_local_uri(uri):
            link_tree(folder, Path(local_file_uri_to_path(uri)))
        else:
            self.client.log_artifacts(run_id, str(folder))

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Keeps other processes away and turns errors into one sentence.

        Every run is written from beginning to end inside, so an unfinished one found inside was
        left by a process that was killed, or by ourselves when MLflow refused in the middle.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        with self.as_tracking_errors(), self._alone():
            if self._interrupted:
                close_leftovers(self)
            self._interrupted = True
            yield
            self._interrupted = False

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """One driver on this folder at a time: no half-made database, no second run of a key."""
        with locked(self.root / "locks" / "tracker.lock"):
            yield

    @contextmanager
    def as_tracking_errors(self) -> Iterator[None]:
        """Turns an error of MLflow or its database into one sentence.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        try:
            yield
        except (TrackingError, DamagedFileError):  # the latter is about an artifact
            raise
        except Exception as error:
            # The cause is left out: its text and those of its own causes may hold secrets.
            raise TrackingError(refusal(error, self.address)) from None
