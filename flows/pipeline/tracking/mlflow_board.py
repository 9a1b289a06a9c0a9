"""The leaderboard in MLflow: an experiment of flat runs, one per row, each with a listed model."""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final
from urllib.parse import quote

from flows.pipeline.plan import Node
from flows.pipeline.tracking.board import Entry, Row, View
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_finished import FinishedRuns
from flows.pipeline.tracking.mlflow_leftovers import delete_row
from flows.pipeline.tracking.mlflow_setup import LEADERBOARD
from flows.pipeline.tracking.mlflow_writes import DIGEST_LENGTH, log_batches, log_datasets
from flows.pipeline.tracking.redaction import without_secrets

__all__ = ["KEY_OF", "MlflowBoard"]

KEY_OF: Final = "key."
"""Begins the name of a row's tag with the key of a node behind it; the node's role ends it."""


class MlflowBoard:
    """Rows that an earlier sweep has written are kept, and marked with every sweep that has them.

    Attributes:
        experiment: The leaderboard's own; its runs have no parents, so MLflow lists them all.
    """

    def __init__(self, ledger: MlflowExperiment, source: str, sweep: str) -> None:
        """Opens the experiment, or makes it, and looks up its rows.

        Args:
            ledger: The experiment with the runs of nodes, in the same MLflow.
            source: What runs, for the column "source" of the UI.
            sweep: Name of the sweep that lists rows.

        Raises:
            TrackingError: MLflow cannot be used.
        """
        self.experiment = MlflowExperiment(ledger.root, source, LEADERBOARD)
        self._ledger, self._sweep = ledger, sweep
        # Id and tags of the run by what the row is about.
        self._rows: dict[str, tuple[str, dict[str, str]]] = {}
        found = FinishedRuns(self.experiment, ("content", f"sweep.{sweep}"), "row", "about")
        with self.experiment.writing():
            for about, run_id, tags in found.all():
                self._rows.setdefault(about, (run_id, dict(tags)))

    def prepare(self, views: Sequence[View]) -> None:
        """Saves views of the leaderboard, see `MlflowExperiment.prepare`."""
        self.experiment.prepare(views)

    def link(self, sweep: str) -> str:
        """Markdown that leads to the rows of a sweep.

        Args:
            sweep: Its name.
        """
        rows = quote(f"tags.`sweep.{sweep}` = 'listed'")
        page = f"#/experiments/{self.experiment.id}/runs?workflowType=machine_learning"
        order = quote("tags.`mlflow.runName`")
        address = f"{page}&searchFilter={rows}&orderByKey={order}&orderByAsc=true"
        return f"[Its results in the leaderboard]({address})"

    def log(self, entry: Entry, runs: Callable[[str], str | None]) -> None:
        """Writes a row; one that is there is marked as this sweep's, too.

        Args:
            entry: The row.
            runs: Says the id of the run of a node by its key.

        Raises:
            TrackingError: MLflow cannot be used.
            DamagedFileError: a file that the row is read from is damaged.
        """
        mark = {f"sweep.{self._sweep}": "listed"}
        run_id, known = self._rows.get(entry.about, ("", {}))
        if known.get("content") == entry.content:
            if not mark.keys() <= known.keys():
                with self.experiment.writing():
                    log_batches(self.experiment.client, run_id, tags=mark)
                known |= mark
            return
        row = entry.row()
        with self.experiment.writing():
            # A driver of another sweep may have written it since this one looked.
            same = f"tags.about = '{entry.about}' and tags.role = 'row'"
            for old in list(self.experiment.search(same)):
                delete_row(self.experiment, old)
            tags = mark | {"about": entry.about, "content": entry.content, "sweep": self._sweep}
            self._rows[entry.about] = (self._write(row, tags, runs), tags)

    def _write(self, row: Row, tags: Mapping[str, str], runs: Callable[[str], str | None]) -> str:
        client, now = self.experiment.client, int(1000 * time.time())
        tags = self.experiment.common | dict(row.tags) | dict(tags)
        tags |= {"role": "row", "mlflow.note.content": row.note}
        tags |= {f"{KEY_OF}{role}": node.key for role, node in row.nodes.items()}
        tags = {name: without_secrets(text) for name, text in tags.items()}
        # Links of ours end in queries; they come first, because the page folds a long note.
        tags["mlflow.note.content"] = self._links(row.nodes, runs) + tags["mlflow.note.content"]
        run = client.create_run(self.experiment.id, run_name=row.name, tags=tags)
        run_id = str(run.info.run_id)
        model = self._list_model(row, tags, runs) if row.model else None
        metrics: list[tuple[Any, ...]] = [
            (name, float(value), now, step)
            # A number is the model's as well: MLflow lists it beside the model.
            + ((model, *_first_dataset(row), run_id) if model and len(points) == 1 else ())
            for name, points in row.metrics.items()
            for step, value in points
        ]
        log_batches(client, run_id, metrics=metrics, params=row.params)
        log_datasets(client, run_id, row.datasets)
        if model:
            from mlflow.entities import LoggedModelOutput

            client.log_outputs(run_id, [LoggedModelOutput(model, 0)])
            client.finalize_logged_model(model, "READY")
        client.set_terminated(run_id, "FINISHED")
        return run_id

    def _list_model(
        self, row: Row, tags: Mapping[str, str], runs: Callable[[str], str | None]
    ) -> str:
        """Lists what is judged among MLflow's models; its files stay with the run that made it."""
        key = row.nodes[row.model].key
        model = self.experiment.client.create_logged_model(
            self.experiment.id,
            name=re.sub(r"[/:.%\"']", "_", row.name),
            source_run_id=runs(key),
            tags={"key": key, "about": tags["about"], "files": f"nodes/{key}"},
            params=dict(row.params),
            model_type=row.model,
        )
        return str(model.model_id)

    def _links(self, nodes: Mapping[str, Node], runs: Callable[[str], str | None]) -> str:
        """Lines that lead to the runs of the nodes behind a row, and to their files."""
        lines = []
        for role, node in nodes.items():
            run_id = runs(node.key)
            page = f"#/experiments/{self._ledger.id}/runs/{run_id}"
            of = "?workflowType=machine_learning"
            link = f"[{node.name}]({page}{of}), [files]({page}/artifacts{of})"
            known = node.name if run_id is None else link
            lines.append(f"- {role}: {known}")
        return "\n".join(lines) + "\n\n"


def _first_dataset(row: Row) -> tuple[str | None, str | None]:
    """Name and digest of the data set that a model's numbers are listed under."""
    if not row.datasets:
        return None, None
    first = row.datasets[0]
    return str(first["name"]), str(first["digest"])[:DIGEST_LENGTH]
