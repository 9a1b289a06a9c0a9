"""Sweeps in MLflow: a parent run per sweep, below it one run per node.

A node's run is written after its artifact is complete on disk. A run that a killed driver left
half-written is closed as KILLED when the store is opened next, and the node gets a whole one.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from components.core.sealed import content_digest, read_record
from flows.pipeline.failures import failure_line
from flows.pipeline.plan import Node, Plan
from flows.pipeline.tracking.board import Entry, View
from flows.pipeline.tracking.mlflow_board import MlflowBoard
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_finished import FinishedRuns
from flows.pipeline.tracking.mlflow_run import flat, read_content
from flows.pipeline.tracking.mlflow_sweep import MlflowSweep
from flows.pipeline.tracking.tracker import Metrics

__all__ = ["MlflowTracker"]

_TAG_LENGTH = 5000
_CONTENT = "content"  # tag: a digest of the artifact's files


class MlflowTracker:
    """The tracker that writes into MLflow.

    Attributes:
        experiment: Holds all runs.
        sweep: The parent run.
    """

    def __init__(self, root: Path | str, source: str = "") -> None:
        """Opens MLflow; makes database and experiment if there are none.

        Args:
            root: Folder of the store.
            source: What runs, for the column "source" of the UI.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self.experiment = MlflowExperiment(root, source)
        self.sweep = MlflowSweep(self.experiment)
        self._source = source
        self._board: MlflowBoard | None = None
        self._finished = FinishedRuns(self.experiment, (_CONTENT,))
        self._runs: dict[str, tuple[str, Mapping[str, str]]] = {}  # id and own tags by key

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Opens the parent run and looks up the runs of the plan's nodes, see `MlflowSweep.open`.

        Raises:
            TrackingError: MLflow cannot be used, or another process is running this sweep.
            ValueError: the name holds other characters.
        """
        self.sweep.open(name, tags, params, plan)
        wanted = None if plan is None else {node.key for node in plan}
        self._finished = FinishedRuns(self.experiment, (_CONTENT, self._mark))
        with self.experiment.writing():
            for key, run_id, found in self._finished.all():
                if wanted is None or key in wanted:
                    self._runs[key] = (run_id, found)

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Ends the parent run, see `MlflowSweep.close`.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self.sweep.close(status, files, metrics)

    def log_node(self, node: Node, folder: Path) -> None:
        """Records a finished node; one that has a run is marked as reused by this sweep.

        Args:
            node: The node.
            folder: Its artifact.

        Raises:
            TrackingError: MLflow cannot be used. The artifact is not touched.
            DamagedFileError: the artifact cannot be read.
        """
        if self.record(node, folder):
            return
        run_id, tags = self._runs[node.key]
        if (self.experiment.root / "damaged" / node.key).exists():
            self.experiment.keep_again(run_id, folder)  # its files are those that were set aside
        if self._mark not in tags:
            with self.experiment.writing():
                self.experiment.client.set_tag(run_id, self._mark, "reused")

    def record(self, node: Node, folder: Path, tags: Mapping[str, str] | None = None) -> bool:
        """Writes the run of a finished node, unless it has one.

        Args:
            node: The node.
            folder: Its artifact.
            tags: Further tags.

        Returns:
            Whether the run was written.

        Raises:
            TrackingError: MLflow cannot be used. The artifact is not touched.
        """
        with self.experiment.writing():
            digest = content_digest(read_record(folder))
            if self._has_run(node.key, digest):
                return False
            content = read_content(folder)
            self.sweep.add_datasets(content.datasets)
            written = flat(content.tags) | self._tags(node)
            written |= {_CONTENT: digest} if digest else {}
            written |= {self._mark: "computed"} | dict(tags or {})
            run_id = self.experiment.write_run(
                node.name,
                written,
                "FINISHED",
                params=flat(dict(node.config)) | content.params,
                metrics=content.metrics,
                datasets=content.datasets,
                folder=folder,
                times=_times(content.record),
            )
            own = {name: written[name] for name in (_CONTENT, self._mark) if name in written}
            self._runs[node.key] = (run_id, own)
            return True

    def run_of(self, node: Node) -> str:
        """Id of the run of a node that is recorded."""
        return self._runs[node.key][0]

    def log_failure(self, node: Node, reason: str) -> None:
        """Records a failed node with its traceback.

        Args:
            node: The node.
            reason: The traceback, or one sentence.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        last = failure_line(reason)
        tags = self._tags(node) | {self._mark: "failed", "error": last[:_TAG_LENGTH]}
        with self.experiment.writing():
            self.experiment.write_run(
                node.name,
                tags,
                "FAILED",
                params=flat(dict(node.config)),
                texts={"traceback.txt": reason},
            )

    def log_entry(self, entry: Entry) -> None:
        """Records a row of the leaderboard, see `MlflowBoard.log`.

        Raises:
            TrackingError: MLflow cannot be used.
            DamagedFileError: a file that the row is read from is damaged.
        """
        self.board.log(entry, lambda key: self._runs.get(key, (None,))[0])

    def prepare(self, views: Sequence[View]) -> None:
        """Saves views on the pages of the leaderboard and of the nodes' runs.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self.experiment.prepare(view for view in views if not view.board)
        if any(view.board for view in views):
            self.board.prepare([view for view in views if view.board])
            self.sweep.add_to_note(self.board.link(self.sweep.name))

    @property
    def board(self) -> MlflowBoard:
        """The leaderboard; a store whose sweeps have no results gets none.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        if self._board is None:
            self._board = MlflowBoard(self.experiment, self._source, self.sweep.name)
        return self._board

    @property
    def _mark(self) -> str:
        """Name of the tag for a node's state in this sweep: computed, reused or failed."""
        return f"sweep.{self.sweep.name}"

    def _has_run(self, key: str, content: str | None) -> bool:
        """Whether there is a run of this result; one of an artifact with other files is deleted."""
        if key not in self._runs:
            # A driver of another sweep may have recorded it since this one started.
            for other, run_id, tags in self._finished.new(key):
                self._runs.setdefault(other, (run_id, tags))
        if key not in self._runs:
            return False
        run_id, tags = self._runs[key]
        if content is None or tags.get(_CONTENT, content) == content:
            return True
        self.experiment.client.delete_run(run_id)  # MLflow's trash keeps it
        del self._runs[key]
        return False

    def _tags(self, node: Node) -> dict[str, str]:
        note = f"**{node.name}**, a node of `{node.component}`"
        if node.inputs:
            note += " made from " + ", ".join(f"{i.name} ({r})" for r, i in node.inputs.items())
        tags = flat(dict(node.tags)) | self.sweep.child_tags
        tags |= {"role": "node", "component": node.component, "key": node.key}
        tags |= {"version": str(node.version)}
        return tags | {"mlflow.note.content": f"{note}."[:_TAG_LENGTH]}


def _times(record: Mapping[str, Any]) -> tuple[int, int]:
    """Start and end in milliseconds since 1970; the end as measured, whatever the clock did."""
    start = int(1000 * record["started"])
    return start, start + int(1000 * max(0.0, record["wall_seconds"]))
