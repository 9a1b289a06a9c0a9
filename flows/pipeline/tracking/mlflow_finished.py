"""Which nodes and rows have a finished run in MLflow, in stores of ten thousand runs.

MLflow's search makes whole runs, with all their metrics, parameters and tags: of ten thousand, many
seconds and hundreds of megabytes, and even for a single key it goes through all of them. So our own
database is asked by its tables, once for everything and later for the runs that are new.
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

__all__ = ["FinishedRuns"]

_WAIT = 20.0  # seconds for another program that writes

Found = tuple[str, str, Mapping[str, str]]
"""Key of a node or of what a row is about, id of its run, and the tags that were asked for."""


class FinishedRuns:
    """The finished runs of one role, by whoever has written them."""

    def __init__(
        self, experiment: Any, tags: Sequence[str], role: str = "node", key: str = "key"
    ) -> None:
        """Asks nothing yet.

        Args:
            experiment: The MlflowExperiment.
            tags: Names of the tags to return.
            role: Of the runs.
            key: Name of the tag that says which one it is.
        """
        self._role, self._key = role, key
        self._experiment, self._tags = experiment, tuple(tags)
        self._last = 0  # number of the newest row of our own database that was looked at

    def all(self) -> Iterator[Found]:
        """All of them, the newest first; to be called while no other process writes a run."""
        if self._experiment.address.own:
            self._last = 0
            yield from self._rows()
        else:
            yield from self._search("")

    def new(self, key: str) -> Iterator[Found]:
        """Those of a node, perhaps with others, that were not there at the last look.

        To be called like `all`. Every run is written from beginning to end by one who is alone, so
        one that is not finished now never will be.
        """
        if self._experiment.address.own:
            yield from self._rows()
        else:
            yield from self._search(f" and tags.{self._key} = '{key}'")

    def _search(self, which: str) -> Iterator[Found]:
        ours = f"attributes.status = 'FINISHED' and tags.role = '{self._role}'"
        for run in self._experiment.search(ours + which):
            tags = run.data.tags
            kept = {name: tags[name] for name in self._tags if name in tags}
            yield tags.get(self._key, ""), run.info.run_id, kept

    def _rows(self) -> list[Found]:
        joined = "".join(
            f" LEFT JOIN tags t{i} ON t{i}.run_uuid = r.run_uuid AND t{i}.key = ?"
            for i in range(len(self._tags))
        )
        values = "".join(f", t{i}.value" for i in range(len(self._tags)))
        # CROSS keeps the order of the joins: runs first, of which few are new.
        query = (
            f"SELECT k.value, r.run_uuid{values} FROM runs r"
            " CROSS JOIN tags k ON k.run_uuid = r.run_uuid AND k.key = ?"
            " CROSS JOIN tags o ON o.run_uuid = r.run_uuid AND o.key = 'role' AND o.value = ?"
            f"{joined} WHERE r.rowid > ? AND r.experiment_id = ? AND r.status = 'FINISHED'"
            " AND r.lifecycle_stage = 'active' ORDER BY r.start_time DESC"
        )
        experiment = self._experiment
        with closing(sqlite3.connect(experiment.address.database, timeout=_WAIT)) as connection:
            [(newest,)] = connection.execute("SELECT coalesce(max(rowid), 0) FROM runs").fetchall()
            given = (self._key, self._role, *self._tags, self._last, int(experiment.id))
            rows = connection.execute(query, given).fetchall()
        self._last = newest
        return [
            (key, run_id, {n: v for n, v in zip(self._tags, tags, strict=True) if v is not None})
            for key, run_id, *tags in rows
        ]
