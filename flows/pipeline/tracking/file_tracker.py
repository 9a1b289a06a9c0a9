"""Sweeps as JSON lines: STORE/tracking/SWEEP.jsonl, for people, `jq` and `pandas.read_json`.

Every line is an event with its `time` in seconds since 1970 and what it is `about`: `open`, `node`,
`failure`, `row` or `close`. An event is written unless the newest one about the same thing is
equal, so a sweep that is run again adds nothing, and a node that failed and then finished has two
lines.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from components.core.files import without_undefined
from components.core.integrity import load_json
from components.core.sealed import check_folder, content_digest, read_record
from flows.pipeline.errors import TrackingError
from flows.pipeline.json_lines import append_line, mend_last_line, read_lines
from flows.pipeline.plan import Node, Plan
from flows.pipeline.tracking.board import Entry, View
from flows.pipeline.tracking.redaction import without_secrets
from flows.pipeline.tracking.sweep_lock import hold_sweep
from flows.pipeline.tracking.tracker import Metrics

__all__ = ["FileTracker", "SweepFile", "describe_node"]


class SweepFile:
    """The file of one sweep, open in one process at a time."""

    def __init__(self, root: Path | str) -> None:
        """Takes the store's folder; nothing is open yet."""
        self._root = Path(root).absolute()
        self._path: Path | None = None
        self._newest: dict[str, dict[str, Any]] = {}
        self._lock = ExitStack()

    def open(self, name: str) -> None:
        """Opens the file of a sweep and reads its events.

        Raises:
            TrackingError: it cannot be read or written, or another process is running this sweep.
            ValueError: the name is none for a sweep.
        """
        path = self._root / "tracking" / f"{name}.jsonl"
        with ExitStack() as held:
            held.enter_context(hold_sweep(self._root, name))
            with _as_tracking_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                mend_last_line(path)
                self._newest = {str(event.get("about")): event for event in read_lines(path)}
            self._lock = held.pop_all()  # an error above gives it back
        self._path = path

    def close(self) -> None:
        """Lets other processes open the sweep."""
        self._path = None
        self._lock.close()

    @property
    def is_open(self) -> bool:
        """Whether events can be written."""
        return self._path is not None

    def named(self, path: Path) -> str:
        """A path as it stays true when the store is moved: within the store, where it lies there.

        Args:
            path: Of a file.
        """
        place = path.absolute()
        return str(place.relative_to(self._root) if place.is_relative_to(self._root) else path)

    def newest(self) -> list[dict[str, Any]]:
        """The newest event about every thing."""
        return list(self._newest.values())

    def has(self, event: str, about: str) -> bool:
        """Whether the newest event about a thing is of this kind."""
        return self._newest.get(about, {}).get("event") == event

    def content(self, about: str) -> str | None:
        """The digest of an artifact's files in the newest event about it; None if it has none."""
        return self._newest.get(about, {}).get("content")

    def write(self, event: str, about: str, content: Mapping[str, Any]) -> None:
        """Adds an event, unless the newest one about the same thing is equal.

        Args:
            event: Its kind.
            about: What it is about: a key, or a name.
            content: Its further fields; JSON-able.

        Raises:
            TrackingError: the file cannot be written.
        """
        if self._path is None:
            raise TrackingError("No sweep is open in the file tracker: open one before it writes.")
        fields = without_undefined({"event": event, "about": about, **content})
        if _text(fields) == _text(self._newest.get(about, {})):
            return
        line = {"time": round(time.time(), 3), **fields}
        with _as_tracking_errors(self._path):
            append_line(self._path, line)
        self._newest[about] = line


def _text(event: Mapping[str, Any]) -> str:
    """An event without its time, as its line has it."""
    fields = {name: value for name, value in event.items() if name != "time"}
    return json.dumps(fields, default=str, sort_keys=True)


@contextmanager
def _as_tracking_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise TrackingError(
            f"The tracker's file {path} cannot be used ({why}); artifacts on disk are safe: "
            "repair or remove it, or choose runner.tracker=none, and give the same command again."
        ) from error


class FileTracker:
    """The tracker that writes JSON lines.

    Attributes:
        file: Of the open sweep.
    """

    def __init__(self, root: Path | str) -> None:
        """Takes the store's folder; nothing is written before a sweep is opened."""
        self.file = SweepFile(root)

    def open(
        self,
        name: str,
        tags: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        plan: Plan | None = None,
    ) -> None:
        """Opens the file of a sweep, see `Tracker.open`.

        Raises:
            TrackingError: the file cannot be used, or another process is running this sweep.
            ValueError: the name is none for a sweep.
        """
        self.file.open(name)
        nodes = None if plan is None else dict(plan.counts())
        content = {"sweep": name, "tags": dict(tags or {}), "params": dict(params or {})}
        self.file.write("open", "open", content | {"nodes": nodes})

    def log_node(self, node: Node, folder: Path) -> None:
        """Records a finished node, see `Tracker.log_node`.

        Raises:
            TrackingError: the file cannot be written.
            DamagedFileError: the artifact cannot be read.
        """
        content = content_digest(read_record(folder))
        known = self.file.content(node.key)
        # Made again to other bytes, it is another result.
        other = known is not None and content is not None and known != content
        if not self.file.has("node", node.key) or other:
            self.file.write("node", node.key, describe_node(node) | _result(folder))

    def log_failure(self, node: Node, reason: str) -> None:
        """Records a failed node, see `Tracker.log_failure`.

        Raises:
            TrackingError: the file cannot be written.
        """
        self.file.write(
            "failure", node.key, describe_node(node) | {"reason": without_secrets(reason)}
        )

    def log_entry(self, entry: Entry) -> None:
        """Records a row of the flat table of results, see `Tracker.log_entry`.

        Raises:
            TrackingError: the file cannot be written.
            DamagedFileError: a file that the row is read from is damaged.
        """
        if self.file.content(entry.about) == entry.content:
            return
        row = entry.row()
        fields = {
            "name": row.name,
            "params": dict(row.params),
            "tags": dict(row.tags),
            "metrics": {name: list(points) for name, points in row.metrics.items()},
            "nodes": {role: node.key for role, node in row.nodes.items()},
            "content": entry.content,
        }
        self.file.write("row", entry.about, fields)

    def prepare(self, views: Sequence[View]) -> None:
        """Does nothing: a file is looked at with other tools."""

    def close(
        self, status: str, files: Iterable[Path] = (), metrics: Metrics | None = None
    ) -> None:
        """Records how the sweep ended, see `Tracker.close`.

        Raises:
            TrackingError: the file cannot be written.
        """
        if not self.file.is_open:
            return
        content = {
            "status": status,
            "files": [self.file.named(file) for file in files],
            "metrics": {name: list(points) for name, points in (metrics or {}).items()},
        }
        try:
            self.file.write("close", "close", content)
        finally:
            self.file.close()


def describe_node(node: Node) -> dict[str, Any]:
    """The fields of every event about a node."""
    return {
        "name": node.name,
        "component": node.component,
        "version": node.version,
        "tags": dict(node.tags),
        "config": dict(node.config),
        "inputs": {role: source.key for role, source in node.inputs.items()},
    }


def _result(folder: Path) -> dict[str, Any]:
    """Numbers and times from an artifact's files; curves stay there."""
    metrics = folder / "metrics.json"
    record = check_folder(folder, (metrics.name,))
    measured = ("started", "finished", "seconds", "device", "hardware", "package")
    return {
        "folder": f"{folder.parent.name}/{folder.name}",
        "content": content_digest(record),
        "metrics": load_json(metrics) if metrics.exists() else {},
        **{name: record[name] for name in measured if name in record},
    }
