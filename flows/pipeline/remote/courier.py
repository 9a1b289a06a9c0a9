"""Carries the small and changing files of a shared store to and fro while work goes on.

A worker sends its progress and its checkpoints and hears requests to end; the driver sends its
record, signs of life and requests, and hears progress. A store that is away for a while delays
this, no more: each look sends what is newest.

Others keep their records in the same store, and in the same copy of it on a machine: each carries
what is its own, which nobody else can know better, and leaves the rest alone.
"""

import json
import threading
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from components.core.files import read_json, write_text
from flows.pipeline.driver import read_driver
from flows.pipeline.errors import StoreError
from flows.pipeline.remote.claims import Claims
from flows.pipeline.remote.objects import Objects
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import REACHED_FILE

__all__ = ["BETWEEN", "DriverCourier", "WorkerCourier", "sweep_claim"]

BETWEEN = 5.0  # seconds between two looks
_QUIET = ("members.json", REACHED_FILE)  # files of a work folder that are no checkpoint
_REQUESTS = ("pause", "stop")


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
        with suppress(StoreError, OSError):
            self.end(early=error is not None)

    def end(self, *, early: bool) -> None:
        """What is left to do when no look can follow; ``early`` if an error ends the block."""
        raise NotImplementedError


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

    def end(self, *, early: bool) -> None:
        """A call that has ended early leaves its last checkpoint to the next one."""
        if early:
            self._save_if_new()


class DriverCourier(_Courier):
    """Gives a driver's signs of life; once it has its sweep, sends what it tells, and hears."""

    def __init__(
        self,
        objects: Objects,
        store: ArtifactStore,
        name: str,
        claims: Claims,
        groups: Collection[str],
    ) -> None:
        """Takes the store and what is the driver's own.

        Args:
            objects: Of the shared store.
            store: This machine's copy.
            name: Of the sweep, which is also that of its record.
            claims: Of the driver.
            groups: Names of the calls that it has sent, as they are at any time.
        """
        super().__init__(objects, store)
        self._sweep, self._claims, self._groups = name, claims, groups
        self._request = f"drivers/{name}.stop"
        self._records = [store.root / folder / f"{name}.json" for folder in ("drivers", "sweeps")]
        self._told: dict[Path, tuple[int, int] | None] = {}
        self._asked: set[str] = set()
        self._begun = False

    def begin(self) -> None:
        """Carries from now on: the sweep is this driver's.

        Raises:
            StoreError: the store cannot be written.
        """
        # What lies here was written by an earlier driver, or has been brought from elsewhere.
        self._told = {file: _version(file) for file in self._records}
        self.objects.delete([self._request])  # to an earlier one: nobody knows this one yet
        self._begun = True

    def look(self) -> None:
        """Sends what is new, takes reports and requests."""
        self._claims.beat()
        if self._holds_sweep():
            self._tell()
            groups = sorted(self._groups)
            self._ask(groups)
            self._hear(groups)

    def _holds_sweep(self) -> bool:
        """Another driver may have taken it over from one that was cut off for long."""
        return self._begun and bool(self._claims.take([sweep_claim(self._sweep)], wait=False))

    def _tell(self) -> None:
        for file in self._records:
            version = _version(file)
            if version is not None and version != self._told.get(file):
                self.objects.write(f"{file.parent.name}/{file.name}", file.read_bytes())
                self._told[file] = version

    def _ask(self, groups: Collection[str]) -> None:
        for group in groups:
            for request in _REQUESTS:
                if (self.store.root / "progress" / f"{group}.{request}").exists():
                    self.objects.write(f"progress/{group}.{request}", b"")
                    self._asked.add(f"progress/{group}.{request}")

    def _hear(self, groups: Collection[str]) -> None:
        names = [f"progress/{group}.json" for group in groups]
        for name, content in self.objects.read_many(names).items():
            report, ours = _value(content), read_json(self.store.root / name)
            if _at(report) > _at(ours):  # a worker on this machine writes here by itself
                write_text(self.store.root / name, content.decode())
        record = read_driver(self.store.root, self._sweep)
        content = self.objects.read(self._request)
        if record is not None and content == record.id.encode():
            write_text(self.store.root / self._request, record.id)
            self.objects.delete([self._request])

    def end(self, *, early: bool) -> None:
        """Sends what is left, when no look can send an older version after it."""
        if self._holds_sweep():
            self._tell()
            self.objects.delete(self._asked)  # a look may have sent one after its call's end


def sweep_claim(name: str) -> str:
    """What the driver of a sweep claims."""
    return f"sweep-{name}"


def _version(file: Path) -> tuple[int, int] | None:
    """Another one for every file that was renamed into this place; None if there is none."""
    with suppress(OSError):
        status = file.stat()
        return status.st_ino, status.st_mtime_ns
    return None


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
