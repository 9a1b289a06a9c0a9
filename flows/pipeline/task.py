"""The contract between the pipeline and the functions that do the work.

A task function is `task(jobs, context) -> None`. It fills every `job.out`, an empty folder, with
any files. Some names are understood by the tracker, all of them optional:

- `metrics.json`   {name: number}, the final scalars.
- `curves.npz`     per metric two arrays `<name>/step` and `<name>/value` (no pickle).
- `params.json`    {name: value}, further parameters to show.
- `tags.json`      {name: text}, further tags.
- `datasets.json`  list of {"name", "digest", "source"}, the data sets that were read.

Checkpoints go to `context.work`, which survives a kill. A checkpoint should say which keys its
lanes belong to: after other sweeps have finished some of them, a call may ask for a part of the
lanes only.
"""

import importlib
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from components.core.files import read_json, without_undefined, write_json

__all__ = [
    "FAILURE_FILE",
    "REACHED_FILE",
    "READ",
    "Job",
    "PauseRequested",
    "StopRequested",
    "TaskContext",
    "TaskFunction",
    "load_task",
]

FAILURE_FILE = "failure.txt"
REACHED_FILE = "reached.json"  # in a work folder: the fraction that its checkpoint holds
_PACED = 0.25  # part of the work over which a pace must have been seen
READ = ("metrics.json", "curves.npz", "params.json", "tags.json", "datasets.json")
"""The files of an artifact that a tracker reads."""


class StopRequested(Exception):  # noqa: N818 - a stop on request, no error
    """Ends a task call that the driver wants stopped; its nodes neither finish nor fail."""


class PauseRequested(Exception):  # noqa: N818 - likewise
    """Ends a task call at a checkpoint; another call will continue from there."""


@dataclass
class Job:
    """One node to be computed.

    Attributes:
        key: The node's key.
        name: The node's run name, for messages.
        config: The node's configuration.
        inputs: Absolute folders of the finished inputs and of what the node reads outside the
            store, by role. Read only.
        out: An empty folder to fill; it becomes the artifact when the task returns.
    """

    key: str
    name: str
    config: dict[str, Any]
    inputs: dict[str, Path]
    out: Path

    def fail(self, reason: str) -> None:
        """Marks this node as failed while the other jobs of the call succeed.

        Args:
            reason: A traceback, or one sentence.
        """
        (self.out / FAILURE_FILE).write_text(reason, encoding="utf-8")


@dataclass
class TaskContext:
    """The surroundings of a task call.

    Attributes:
        work: Folder for checkpoints; survives a kill and is removed when all is published.
        members: Keys the work folder was made for, in the order of their first call.
        device: "cpu" or "cuda".
        threads: Threads this call may use.
        progress_file: Takes the fraction done and held-out losses; None for no file.
        stop_file: Once this file exists, the next validation ends the call; None for never.
        pause_file: Once this file exists, the next checkpoint ends the call; None for never.
        watch: Called at every report, by executors that compute in the driver's own process.
        interval: Seconds between two writes of the fraction.
    """

    work: Path
    members: list[str] = field(default_factory=list)
    device: str = "cpu"
    threads: int = 1
    progress_file: Path | None = None
    stop_file: Path | None = None
    pause_file: Path | None = None
    watch: Callable[[], None] = lambda: None
    interval: float = 0.5
    _written: float = field(default=float("-inf"), repr=False)
    _fraction: float = field(default=0.0, repr=False)
    _losses: list[tuple[float, float]] = field(default_factory=list, repr=False)
    _saved: int = field(default=0, repr=False)
    _begun: Mapping[str, Any] = field(default_factory=dict, repr=False)
    _first: tuple[float, float] | None = field(default=None, repr=False)
    _last: tuple[float, float] = field(default=(0.0, 0.0), repr=False)

    @property
    def steady_seconds(self) -> float | None:
        """Seconds that all the work takes at the pace of the fractions reported; None if unknown.

        What comes before the first and after the last of them does not count, such as loading data,
        and so neither does the overhead of the call; preparations that are reported as 0 do.
        """
        if self._first is None or self._last[1] - self._first[1] < _PACED:
            return None
        return (self._last[0] - self._first[0]) / (self._last[1] - self._first[1])

    def begin(self) -> None:
        """Reports the fraction at which the call starts: more than 0 from a checkpoint."""
        self._saved = self._newest_checkpoint()
        value = read_json(self.work / REACHED_FILE)
        reached = value if isinstance(value, float) else 0.0
        place = {"host": socket.gethostname(), "pid": os.getpid()}
        self._begun = place | {"began": time.time(), "began_at": reached}
        self.progress(reached)
        self._first = None

    def progress(self, fraction: float) -> None:
        """Reports the fraction done, for the display. Cheap enough for every training step.

        Args:
            fraction: Between 0 and 1, over all jobs of the call.

        Raises:
            PauseRequested: The pause file is there, and a new checkpoint.
        """
        former = self._fraction
        self._reach(fraction)
        if time.monotonic() - self._written >= self.interval:
            saved = self._note_checkpoint(former)
            self._write()
            self.watch()
            asked = self.pause_file is not None and self.pause_file.exists()
            if asked and saved and self._fraction < 1.0:
                raise PauseRequested(f"paused at {self._fraction:.0%} of the budget")

    def validated(self, fraction: float, loss: float) -> None:
        """Reports an intermediate held-out loss, and ends the call if the driver wants it stopped.

        Args:
            fraction: Part of the budget that is spent, between 0 and 1.
            loss: Held-out loss.

        Raises:
            StopRequested: The stop file is there.
        """
        self._reach(fraction)
        self._losses.append((self._fraction, float(loss)))
        self._write()
        self.watch()
        if self.stop_file is not None and self.stop_file.exists():
            raise StopRequested(f"stopped at {self._fraction:.0%} of the budget")

    def _reach(self, fraction: float) -> None:
        former, self._fraction = self._fraction, min(1.0, max(0.0, float(fraction)))
        now = time.monotonic()
        self._first = self._first or (now, self._fraction)
        if self._fraction > former:
            self._last = now, self._fraction

    def _note_checkpoint(self, reached: float) -> bool:
        """Notes how far a new checkpoint is, for whoever continues from it after a kill.

        That is the fraction reported last before the checkpoint was seen.

        Returns:
            Whether there is a new one.
        """
        if self.progress_file is None:
            return False
        newest = self._newest_checkpoint()
        if newest == self._saved:
            return False
        write_json(self.work / REACHED_FILE, reached)
        self._saved = newest
        return True

    def _newest_checkpoint(self) -> int:
        """When the newest checkpoint was written. Folders are none: snapshots are no states."""
        return max(
            (
                entry.stat().st_mtime_ns
                for entry in os.scandir(self.work)
                if entry.is_file() and entry.name != REACHED_FILE
            ),
            default=0,
        )

    def _write(self) -> None:
        if self.progress_file is not None:
            self._written = time.monotonic()
            report = {"fraction": self._fraction, "losses": self._losses, "at": time.time()}
            write_json(self.progress_file, without_undefined(report | self._begun))


TaskFunction = Callable[[Sequence[Job], TaskContext], None]


def load_task(path: str) -> TaskFunction:
    """Imports a task function.

    Args:
        path: "package.module:function".

    Raises:
        ValueError: there is no such function.
    """
    module, _, name = path.partition(":")
    function = getattr(importlib.import_module(module), name, None)
    if not callable(function):
        raise ValueError(f"There is no task function {name!r} in {module}; correct the plan.")
    return cast(TaskFunction, function)
