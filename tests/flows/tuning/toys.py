"""A model that needs no data: its loss is known, and every fit is counted outside the store."""

import json
import os
import signal
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from components.core.files import read_json, write_json
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import Job, TaskContext
from flows.tuning.journal import open_journal
from flows.tuning.outcome import SearchOutcome
from flows.tuning.search import search
from flows.tuning.space import Choice, Range, Space
from flows.tuning.study import Study, StudySpecification
from flows.tuning.trials import NullTrials
from tests.flows.pipeline.toys import count, wait_for

STEPS = 20
SPACE: Space = {"x": Range(0.0, 1.0, log=False), "mood": Choice(("good", "bad"))}


@dataclass(frozen=True, kw_only=True)
class ToyConfig:
    """Settings; `log` is a folder outside the store."""

    log: str
    x: float = 0.9
    mood: str = "good"
    steps: int = STEPS

    def __post_init__(self) -> None:
        if self.x == 0.0:  # which no random draw hits: three digits of it are never all zero
            raise ValueError("x must not be 0.")


def loss(settings: dict[str, Any]) -> float:
    """The lowest one is at x = 0.3."""
    return (settings["x"] - 0.3) ** 2 + (1.0 if settings["mood"] == "bad" else 0.0)


def fit(jobs: Sequence[Job], context: TaskContext) -> None:
    """Approaches the loss step by step, with a checkpoint after each.

    A file in the log folder changes what it does: `die-N` kills the process at step N, once;
    `interrupt` presses Ctrl-C at step 5, once; `fail-bad` makes trials with `mood=bad` fail;
    with `hold` it waits at step 5 for `go`, with `slow-KEY` late in the fit for the driver to stop
    it.
    """
    (job,) = jobs
    settings, checkpoint = job.config["settings"], context.work / "checkpoint.json"
    log = Path(settings["log"])
    for step in range(read_json(checkpoint) or 0, settings["steps"]):
        count(settings["log"], f"step-{job.key}")
        if (log / f"die-{step}").exists():
            (log / f"die-{step}").unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        if step == 5 and (log / "interrupt").exists():
            (log / "interrupt").unlink()
            raise KeyboardInterrupt
        if step == 5 and (log / "hold").exists():
            count(settings["log"], "holding")
            wait_for((log / "go").exists, "the file go")
        if settings["mood"] == "bad" and (log / "fail-bad").exists():
            raise ValueError("this toy is in a bad mood")
        write_json(checkpoint, step + 1)
        if (log / f"slow-{job.key}").exists() and step > 0.6 * settings["steps"]:
            wait_for(context.stop_file.exists, "the driver's judgement")
        context.validated((step + 1) / settings["steps"], loss(settings) + 0.5 / (step + 1))
    count(settings["log"], f"finished-{job.key}")
    # Not by `write_json`: artifacts of earlier versions hold losses that are not finite.
    (job.out / "metrics.json").write_text(json.dumps({"validation_loss": loss(settings)}))


def data_node() -> Node:
    """Stands for a dataset; never computed."""
    return Node("data", "data/toy", "tests.flows.tuning.toys:fit", 1, {"toy": True})


def specification(log: Path, **start: Any) -> StudySpecification:
    """A search of the toy."""

    def node(config: ToyConfig) -> Node:
        return Node(
            component="model_fitting",
            name="toy/made-up",
            task="tests.flows.tuning.toys:fit",
            version=1,
            config={"model": "toy", "settings": asdict(config), "seed": 0},
            tags={"dataset": "made-up", "model": "toy"},
        )

    return StudySpecification(
        "made-up", "toy", ToyConfig(log=str(log), **start), SPACE, data_node(), node
    )


def study(home: Path, log: Path, **start: Any) -> Study:
    """The study as a new driver opens it."""
    return Study(specification(log, **start), open_journal(home / "optuna" / "journal.log"))


def run(home: Path, log: Path, trials: int, **kind: Any) -> SearchOutcome:
    """A whole search by a new driver, in this process."""
    notes = kind.pop("notes", [])
    tracker = kind.pop("tracker", NullTrials())
    executor = kind.pop("executor", None) or SerialExecutor()
    limit = kind.pop("limit", lambda: "")
    found = [study(home, log, **kind)]
    store = ArtifactStore(home)
    return search(found, trials, store, tracker, executor, notes.append, limit=limit)
