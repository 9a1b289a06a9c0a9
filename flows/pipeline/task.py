"""The contract between the pipeline and the functions that do the work.

A task function is `task(jobs, context) -> None`. It fills every `job.out`, an empty folder, with
any files. Some names are understood by the ledger, all of them optional:

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
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from flows.pipeline.files import write_json

__all__ = ["FAILURE_FILE", "Job", "TaskContext", "TaskFunction", "load_task"]

FAILURE_FILE = "failure.txt"


@dataclass
class Job:
    """One node to be computed.

    Attributes:
        key: The node's key.
        name: The node's run name, for messages.
        config: The node's configuration.
        inputs: Absolute folders of the finished inputs, by role. Read only.
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
    """Where a task call runs.

    Attributes:
        work: Folder for checkpoints; survives a kill and is removed when all is published.
        members: Keys the work folder was made for, in the order of their first call.
        device: "cpu" or "cuda".
        threads: Threads this call may use.
        progress_file: Where the fraction done is written; None for nowhere.
        interval: Seconds between two writes of the fraction.
    """

    work: Path
    members: list[str] = field(default_factory=list)
    device: str = "cpu"
    threads: int = 1
    progress_file: Path | None = None
    interval: float = 0.5
    _written: float = field(default=float("-inf"), repr=False)

    def progress(self, fraction: float) -> None:
        """Tells the display how far this call is. Cheap enough for every training step.

        Args:
            fraction: Between 0 and 1, over all jobs of the call.
        """
        if self.progress_file is None:
            return
        now = time.monotonic()
        if now - self._written < self.interval:
            return
        self._written = now
        write_json(self.progress_file, {"fraction": min(1.0, max(0.0, float(fraction)))})

    def validated(self, fraction: float, loss: float) -> None:
        """Takes a held-out loss on the way; what a search makes of it is its own business."""


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
