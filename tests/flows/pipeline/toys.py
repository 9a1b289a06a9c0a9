"""Small tasks for the pipeline's own tests. Each counts its executions in a file outside the store.

Configurations hold `log`, a folder: paths in a configuration are fine for toys only.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from components.core.files import read_json, write_json
from components.core.integrity import DamagedFileError
from flows.pipeline.plan import Node
from flows.pipeline.task import Job, TaskContext

HERE = "tests.flows.pipeline.toys"


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 300.0) -> Any:
    """Polls until a condition holds; the one place where these tests wait."""
    pause = threading.Event()
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"waited {seconds} s in vain for {what}")
        pause.wait(0.02)
    return value


def count(log: str, word: str) -> None:
    """Adds one line to a file; small appends of several processes do not mix."""
    with open(Path(log) / word, "a", encoding="utf-8") as file:
        file.write("x\n")


def counted(log: Path, word: str) -> int:
    """How often `count` was called."""
    path = Path(log) / word
    return len(path.read_text(encoding="utf-8").splitlines()) if path.exists() else 0


def finish(job: Job, value: float) -> None:
    """Writes an artifact with a value and a learning curve."""
    write_json(job.out / "value.json", value)
    write_json(job.out / "metrics.json", {"value": value})
    steps = np.arange(10)
    np.savez(
        job.out / "curves.npz", **{"train/loss/step": steps, "train/loss/value": value + steps}
    )
    read = [{"name": "toy", "digest": "d" * 64, "source": "made up"}]
    write_json(job.out / "datasets.json", read)
    write_json(job.out / "tags.json", {"colour": "blue"})
    (job.out / "deep").mkdir()
    (job.out / "deep" / "blob.bin").write_bytes(b"blob")
    count(job.config["log"], f"finished-{job.config['id']}")


def number(jobs: Sequence[Job], context: TaskContext) -> None:
    """Writes the number of the configuration."""
    for job in jobs:
        finish(job, float(job.config["number"]))


def number_of_a_file(jobs: Sequence[Job], context: TaskContext) -> None:
    """Writes what stands in the file `number` of the log folder; not reproducible."""
    for job in jobs:
        finish(job, float((Path(job.config["log"]) / "number").read_text()))


def total(jobs: Sequence[Job], context: TaskContext) -> None:
    """Adds the values of all inputs."""
    for job in jobs:
        finish(job, sum(read_json(folder / "value.json") for folder in job.inputs.values()))


def steps(jobs: Sequence[Job], context: TaskContext) -> None:
    """Counts to `steps` for all lanes at once, with a checkpoint after each step.

    With `hold` it waits at that step, as long as `patience` lets it, until a file named `go` is in
    the log folder.
    """
    checkpoint = context.work / "checkpoint.json"
    state = read_json(checkpoint) or {"step": 0, "values": {job.key: 0.0 for job in jobs}}
    config = jobs[0].config
    values = {job.key: state["values"][job.key] for job in jobs}
    for step in range(state["step"], config["steps"]):
        if step == config.get("hold"):
            count(config["log"], "holding")
            patience = config.get("patience", 60.0)
            wait_for((Path(config["log"]) / "go").exists, "the file go", patience)
        for job in jobs:
            values[job.key] += job.config["number"]
            count(config["log"], f"step-{job.config['id']}")
        write_json(checkpoint, {"step": step + 1, "values": values})
        context.progress((step + 1) / config["steps"])
        if config.get("pause"):
            threading.Event().wait(config["pause"])
    for job in jobs:
        finish(job, values[job.key])


def needs_room(jobs: Sequence[Job], context: TaskContext) -> None:
    """Counts like `steps`, but finds no memory after the first one if there are too many lanes.

    There is room for as many as the file `room` in the log folder says.
    """
    import torch  # most toys do without it

    config = jobs[0].config
    state = read_json(context.work / "checkpoint.json")
    if len(jobs) > int((Path(config["log"]) / "room").read_text()):
        if state is None:
            values = {job.key: job.config["number"] for job in jobs}
            write_json(context.work / "checkpoint.json", {"step": 1, "values": values})
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")
    steps(jobs, context)


def checked_steps(jobs: Sequence[Job], context: TaskContext) -> None:
    """Adds up in the loop that all learners use, with its checkpoints."""
    from tests.flows.pipeline.toy_learner import learn  # most toys do without PyTorch

    for job in jobs:
        config = job.config
        checkpoint = context.work / "checkpoint.safetensors"
        settings = (config["number"], config["steps"], config["hold"], Path(config["log"]))
        finish(job, learn(checkpoint, job.key, *settings))


def cannot_read(jobs: Sequence[Job], context: TaskContext) -> None:
    """Expects something else of its inputs."""
    path = next(iter(jobs[0].inputs.values())) / "value.json"
    raise DamagedFileError(f"{path} is no policy", path)


def fails(jobs: Sequence[Job], context: TaskContext) -> None:
    """Raises, unless a file named `repaired` is in the log folder."""
    if not (Path(jobs[0].config["log"]) / "repaired").exists():
        raise ValueError("this toy fails on purpose")
    number(jobs, context)


def fails_in_part(jobs: Sequence[Job], context: TaskContext) -> None:
    """Marks the jobs whose number is negative as failed and finishes the others."""
    for job in jobs:
        if job.config["number"] < 0:
            job.fail("the number is negative")
        else:
            finish(job, job.config["number"])


def threads(jobs: Sequence[Job], context: TaskContext) -> None:
    """Writes how many threads numerical libraries were allowed."""
    for job in jobs:
        finish(job, float(os.environ["OMP_NUM_THREADS"]))


def nothing(jobs: Sequence[Job], context: TaskContext) -> None:
    """Writes nothing."""


def interrupted(jobs: Sequence[Job], context: TaskContext) -> None:
    """As if somebody pressed Ctrl-C."""
    raise KeyboardInterrupt


def terminated(jobs: Sequence[Job], context: TaskContext) -> None:
    """As if a batch system ended this process."""
    signal.raise_signal(signal.SIGTERM)


def terminated_once(jobs: Sequence[Job], context: TaskContext) -> None:
    """As if a batch system ended this process, the first time."""
    if not (context.work / "met-death").exists():
        (context.work / "met-death").touch()
        terminated(jobs, context)
    number(jobs, context)


def dies_once(jobs: Sequence[Job], context: TaskContext) -> None:
    """Kills its own process after a checkpoint, the first time."""
    if not (context.work / "met-death").exists():
        (context.work / "met-death").touch()
        count(jobs[0].config["log"], f"deaths-{jobs[0].config['id']}")
        os.kill(os.getpid(), signal.SIGKILL)
    number(jobs, context)


def dies_always(jobs: Sequence[Job], context: TaskContext) -> None:
    """Kills its own process every time."""
    count(jobs[0].config["log"], f"deaths-{jobs[0].config['id']}")
    os.kill(os.getpid(), signal.SIGKILL)


def node(
    function: str,
    name: str,
    log: Path,
    inputs: dict[str, Node] | None = None,
    *,
    component: str = "toys",
    lanes: str = "",
    cost: float = 1.0,
    **config: Any,
) -> Node:
    """A node that runs one of these tasks."""
    return Node(
        component=component,
        name=name,
        task=f"{HERE}:{function}",
        version=1,
        config={"log": str(log), "id": name, **config},
        inputs=inputs or {},
        tags={"dataset": "toy", "algorithm": function, "seed": "0"},
        lanes=lanes,
        cost=cost,
    )


def record_of(key: str, **values: Any) -> dict[str, Any]:
    """The least that the record of a finished node holds."""
    measured = {"cost": 1.0, "started": 1.0, "finished": 2.0, "seconds": 1.0}
    return {"key": key, "name": key, "component": "toys", "inputs": {}} | measured | values


def diamond(log: Path, pause: float = 0.05, hold: int = -1, patience: float = 60.0) -> list[Node]:
    """Two numbers, two groups of three counters on them, one sum.

    With `hold` the counters wait at that step for the file `go`, at most `patience` seconds.
    """
    numbers = [
        node("number", f"n{i}", log, component="data", number=i + 1, cost=0.1) for i in range(2)
    ]
    lanes = [
        node(
            "steps",
            f"s{i}{lane}",
            log,
            {"start": source},
            component="train",
            lanes=f"group{i}",
            number=lane + 1,
            steps=20,
            pause=pause,
            hold=hold,
            patience=patience,
        )
        for i, source in enumerate(numbers)
        for lane in range(3)
    ]
    inputs = {f"part{i}": lane for i, lane in enumerate(lanes)}
    return [node("total", "sum", log, inputs, component="collect", cost=0.1)]
