"""Kills a driver at every step it takes, and continues each time. Run by test_crashes as a process.

    python -m tests.flows.pipeline.crash_points disk FOLDER
    python -m tests.flows.pipeline.crash_points tracker FOLDER

For each point a child is forked that kills itself with SIGKILL there: in front of the n-th change
of the disk (found with an audit hook; the tracker writes a file), or in front of the n-th call of
MLflow. A second child then runs the same plan to its end. What went wrong is printed, one line per
problem, and at last the number of points.
"""

import os
import shutil
import signal
import sqlite3
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from components.core.files import read_json
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.json_lines import read_lines
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.file_tracker import FileTracker
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import Tracker
from tests.flows.pipeline.toys import counted, node

_CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "open")


def small_plan(log: Path) -> list[Node]:
    """One number, two lanes on it, one sum."""
    start = node("number", "n", log, number=1)
    lanes = [
        node("steps", f"s{i}", log, {"a": start}, lanes="s", number=i + 1, steps=3)
        for i in range(2)
    ]
    return [node("total", "sum", log, {"a": lanes[0], "b": lanes[1]})]


def disk_run(home: Path, log: Path) -> bool:
    """Runs the plan with the tracker that writes a file."""
    return _run(home, log, FileTracker(home))


def tracker_run(home: Path, log: Path) -> bool:
    """Runs the plan with MLflow."""
    return _run(home, log, MlflowTracker(home))


def _run(home: Path, log: Path, tracker: Tracker) -> bool:
    with open(os.devnull, "w", encoding="utf-8") as null:
        display = Display(Console(file=null))
        store = ArtifactStore(home)
        plan = Plan(small_plan(log))
        tracker.open("crash", plan=plan)
        outcome = run_plan(plan, store, tracker, display, executor=SerialExecutor())
        tracker.close(outcome.status)
    # 1 and 2 added up three times.
    value = read_json(store.path(plan.nodes[-1].key) / "value.json")
    return outcome.exit_code == 0 and value == 9.0


def in_child(work: Callable[[], bool]) -> int:
    """Does something in a forked process; its exit status, negative for a signal."""
    child = os.fork()
    if child == 0:
        status = 3
        try:
            status = 0 if work() else 2
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def die_at_change(point: int, home: Path) -> None:
    """Arms this process: SIGKILL in front of the n-th change of the disk below a folder."""
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in _CHANGES or not isinstance(arguments[0], str | os.PathLike):
            return
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & os.O_CREAT):
            return
        if str(home) in str(arguments[0]):
            seen += 1
            if seen == point:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def die_at_call(point: int) -> None:
    """Arms this process: SIGKILL in front of the n-th call that changes MLflow's database."""
    from mlflow import MlflowClient

    seen = 0

    def wrap(name: str) -> None:
        original = getattr(MlflowClient, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal seen
            seen += 1
            if seen == point:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*args, **kwargs)

        setattr(MlflowClient, name, call)

    names = ["create_experiment", "create_run", "log_batch", "log_inputs", "set_tag"]
    for name in [*names, "set_terminated", "update_run"]:
        wrap(name)


def sweep(
    folder: Path,
    run: Callable[[Path, Path], bool],
    arm: Callable[[int, Path], None],
    check: Callable[[Path], str],
    template: Path | None = None,
) -> int:
    """Goes through all points, the number of which is printed at last."""
    point = 0
    while True:
        point += 1
        place = folder / f"point{point}"
        home, log = place / "mlruns", place / "log"
        log.mkdir(parents=True)
        if template is not None:
            shutil.copytree(template, home)
            with sqlite3.connect(home / "mlflow.db") as database:
                place_of_artifacts = "update experiments set artifact_location = ?"
                database.execute(place_of_artifacts, ((home / "artifacts").as_uri(),))
            database.close()

        def first(point: int = point, home: Path = home, log: Path = log) -> bool:
            arm(point, home)
            return run(home, log)

        status = in_child(first)
        if status == 0:
            break
        published = {key.name for key in home.glob("nodes/*")}
        plan = Plan(small_plan(log))
        before = {n.name: counted(log, f"finished-{n.name}") for n in plan if n.key in published}
        second = in_child(lambda home=home, log=log: run(home, log))
        again = {name for name, n in before.items() if counted(log, f"finished-{name}") != n}
        left = sorted(path.name for path in (home / "work").iterdir())
        problems = [check(home)]
        problems += [f"statuses {status}, {second}"] if (status, second) != (-9, 0) else []
        problems += [f"finished nodes ran again: {again}"] if again else []
        problems += [f"left in work: {left}"] if left else []
        for problem in filter(None, problems):
            sys.stdout.write(f"point {point}: {problem}\n")
        shutil.rmtree(place)
    return point - 1


def check_file(home: Path) -> str:
    """One line per node, one beginning, one end."""
    events = read_lines(home / "tracking" / "crash.jsonl")
    kinds = Counter(event["event"] for event in events)
    keys = {event["about"] for event in events if event["event"] == "node"}
    whole = kinds == {"open": 1, "node": 4, "close": 1} and len(keys) == 4
    return "" if whole else f"the tracker's file holds {dict(kinds)} of {len(keys)} nodes"


def check_tracker(home: Path) -> str:
    """One finished run per node, all under one parent, none left open, no run without its files."""
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=f"sqlite:///{home}/mlflow.db")
    experiment = client.get_experiment_by_name("proximity-bench")
    runs = client.search_runs([experiment.experiment_id])
    done = [run for run in runs if run.info.status == "FINISHED"]
    parents = [run for run in runs if run.data.tags["role"] == "sweep"]
    keys = [run.data.tags["key"] for run in done if run.data.tags["role"] == "node"]
    problems = []
    if len(parents) != 1 or parents[0].info.status != "FINISHED":
        problems.append(f"{len(parents)} parents")
    if len(keys) != 4 or len(set(keys)) != 4:
        problems.append(f"{len(keys)} finished runs of {len(set(keys))} nodes")
    if any(run.info.status not in ("FINISHED", "KILLED") for run in runs):
        problems.append("open runs")
    for run in done:
        place = home / "artifacts" / run.info.run_id / "artifacts"
        whole = (place / "node.json").exists() and {"log", "hardware"} <= run.data.params.keys()
        if run.data.tags["role"] == "node" and not whole:
            problems.append(f"run of {run.info.run_name} is not whole")
    return "; ".join(problems)


def main(what: str, folder: Path) -> int:
    """Runs one of the two sweeps."""
    os.fsync = lambda handle: None  # processes end here, the power stays
    if what == "disk":
        points = sweep(folder, disk_run, die_at_change, check_file)
    else:
        template = folder / "template"
        in_child(lambda: MlflowTracker(template) is not None)
        # Here and now, so that no child spends seconds on imports.
        MlflowTracker(folder / "warm")
        points = sweep(
            folder, tracker_run, lambda n, home: die_at_call(n), check_tracker_of, template
        )
    sys.stdout.write(f"points: {points}\n")
    return 0


def check_tracker_of(home: Path) -> str:
    """Checks in a child: the parent, which forks, should hold no database connection."""
    reader, writer = os.pipe()

    def work() -> bool:
        os.write(writer, check_tracker(home).encode())
        return True

    status = in_child(work)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        return pipe.read() if status == 0 else "the tracker cannot be read"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
