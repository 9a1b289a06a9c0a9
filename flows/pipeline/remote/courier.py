"""Carries the small and changing files of a shared store to and fro while work goes on.

A worker sends its progress and its checkpoints and hears requests to end; the driver sends its
record, signs of life and requests, and hears progress. A store that is away for a while delays
this, no more: each look sends what is newest.
"""

import json
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from components.core.files import read_json, write_text
from flows.pipeline.errors import StoreError
from flows.pipeline.remote.objects import Objects
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import REACHED_FILE

__all__ = ["BETWEEN", "DriverCourier", "WorkerCourier"]

BETWEEN = 5.0  # seconds between two looks
_QUIET = ("members.json", REACHED_FILE)  # files of a work folder that are no checkpoint
_REQUESTS = ("pause", "stop")
_RECORDS = ("drivers", "sweeps")


class _Courier:
    """Looks again and again, in a thread, for the length of a `with` block."""

    def __init__(self, objects: Objects, store: ArtifactStore) -> None:
        self.objects, self.store = objects, store
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def look(self) -> None:
        raise NotImplementedError

    def _work(self) -> None:
        while True:
            with suppress(StoreError, OSError):  # the next look does what this one could not
                self.look()
            if self._over.wait(BETWEEN):
                return

    def __enter__(self) -> Any:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()


class WorkerCourier(_Courier):
    """Sends what a call reports and saves, and hears when it is to end."""

    def __init__(
        self,
        objects: Objects,
        store: ArtifactStore,
        group: str,
        work: Path,
        save: Callable[[], None],
    ) -> None:
        """Takes the call's group, its work folder and what pushes that."""
        super().__init__(objects, store)
        self._group, self._folder, self._save = group, work, save
        self._told: Any = None
        self._saved = 0

    def look(self) -> None:
        """Sends what is new and takes requests."""
        named = {f"progress/{self._group}.{request}": request for request in _REQUESTS}
        for name in self.objects.read_many(list(named)):
            (self.store.root / name).touch()
        report = read_json(self.store.progress_file(self._group))
        if report is not None and report != self._told:
            content = json.dumps(report).encode()
            self.objects.write(f"progress/{self._group}.json", content)
            self._told = report
        self._save_if_new()

    def _save_if_new(self) -> None:
        newest = _newest(self._folder)
        if newest != self._saved:
            self._save()
            self._saved = newest

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """A call that has ended early leaves its last checkpoint to the next one."""
        super().__exit__(kind, error, trace)
        if error is not None:
            with suppress(StoreError, OSError):
                self._save_if_new()


class DriverCourier(_Courier):
    """Sends what a driver tells, and hears how its workers do."""

    def __init__(self, objects: Objects, store: ArtifactStore, beat: Callable[[], None]) -> None:
        """Takes the store and what gives a sign of life."""
        super().__init__(objects, store)
        self._beat = beat
        self._told: dict[Path, int] = {}

    def look(self) -> None:
        """Sends what is new, takes reports and requests."""
        self._beat()
        self._tell()
        self._ask()
        self._hear()

    def _tell(self) -> None:
        for folder in _RECORDS:
            for file in sorted((self.store.root / folder).glob("[!.]*.json")):
                changed = file.stat().st_mtime_ns
                if self._told.get(file) != changed:
                    self.objects.write(f"{folder}/{file.name}", file.read_bytes())
                    self._told[file] = changed

    def _ask(self) -> None:
        for request in _REQUESTS:
            for file in (self.store.root / "progress").glob(f"*.{request}"):
                self.objects.write(f"progress/{file.name}", b"")

    def _hear(self) -> None:
        names = [n for n in self.objects.sizes("progress") if n.endswith(".json")]
        for name, content in self.objects.read_many(names).items():
            report, ours = _value(content), read_json(self.store.root / name)
            if _at(report) > _at(ours):  # a worker on this machine writes here by itself
                write_text(self.store.root / name, content.decode())
        stops = [n for n in self.objects.sizes("drivers") if n.endswith(".stop")]
        for name, content in self.objects.read_many(stops).items():
            write_text(self.store.root / name, content.decode(errors="replace"))
            self.objects.delete([name])

    def last(self) -> None:
        """Sends what is left."""
        self._tell()


def _newest(folder: Path) -> int:
    """When the newest checkpoint was written; 0 without one."""
    with suppress(OSError):
        files = [path for path in folder.iterdir() if path.is_file()]
        times = [
            path.stat().st_mtime_ns
            for path in files
            if path.name not in _QUIET and not path.name.startswith(".")
        ]
        return max(times, default=0)
    return 0


def _value(content: bytes) -> Any:
    try:
        return json.loads(content)
    except ValueError:
        return None


def _at(report: Any) -> float:
    at = report.get("at") if isinstance(report, dict) else None
    return float(at) if isinstance(at, int | float) else float("-inf")
