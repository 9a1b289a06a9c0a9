"""Overhead of the pipeline per node, measured with a task that does nothing.

`python -m benchmarks.pipeline [--nodes 40] [--repetitions 3]`. Half of the nodes read the other
half; everything runs in this process, one after the other. Besides the serial runner that means a
work folder, an artifact published whole, and, with the MLflow tracker, one run with parameters,
tags, metrics, a data set and the artifact. A second pass finds everything finished. Making the
database and importing MLflow are left out: a sweep pays for them once.
"""

import argparse
import io
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from rich.console import Console

from benchmarks.measure import computer, markdown, median_seconds
from components.core.files import write_json
from flows.pipeline.executors.executor import Executor
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import Job, TaskContext
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import NullTracker, Tracker

__all__ = [
    "empty",
    "empty_plan",
    "own_database",
    "report",
    "run_empty",
    "seconds_per_plan",
]


def empty(jobs: Sequence[Job], context: TaskContext) -> None:
    """The least a task must do: write something."""
    for job in jobs:
        write_json(job.out / "metrics.json", {"value": 1.0})
        entry = {"name": "nothing", "digest": "0" * 32, "source": "made up"}
        write_json(job.out / "datasets.json", [entry])


def empty_plan(nodes: int, number: int) -> Plan:
    """A plan of empty nodes, the second half reading the first; `number` makes keys differ."""
    task = "benchmarks.pipeline:empty"
    first = [
        Node("benchmark", f"source/{i}", task, 1, {"id": i, "plan": number}, tags={"half": "first"})
        for i in range(nodes // 2)
    ]
    second = [
        Node("benchmark", f"sink/{i}", task, 1, {"id": i, "plan": number}, inputs={"source": node})
        for i, node in enumerate(first)
    ]
    return Plan([*first, *second])


@contextmanager
def own_database() -> Iterator[None]:
    """Keep the measurements out of a tracking server that the user may have."""
    address = os.environ.pop("MLFLOW_TRACKING_URI", None)
    try:
        yield
    finally:
        if address is not None:
            os.environ["MLFLOW_TRACKING_URI"] = address


def run_empty(
    plan: Plan, store: ArtifactStore, tracker: Tracker, executor: Executor | None = None
) -> None:
    """Compute a plan of empty nodes, by default in this process.

    Raises:
        RuntimeError: A node failed.
    """
    display = Display(Console(file=io.StringIO()))
    outcome = run_plan(plan, store, tracker, display, executor=executor or SerialExecutor())
    if not outcome.complete or outcome.unrecorded:
        raise RuntimeError(f"An empty plan did not finish: {outcome}.")


def seconds_per_plan(nodes: int, repetitions: int) -> dict[str, float]:
    """Median seconds of a plan of empty nodes, computed without and with MLflow, and found.

    Args:
        nodes: Per plan, an even number.
        repetitions: Timings each.

    Raises:
        RuntimeError: A node failed.
    """
    with tempfile.TemporaryDirectory() as folder, own_database():
        store, bare = ArtifactStore(Path(folder) / "recorded"), ArtifactStore(Path(folder) / "bare")
        tracker = MlflowTracker(store.root, source="benchmarks.pipeline")
        tracker.open("empty")
        numbers = count()

        def fresh(store: ArtifactStore, tracker: Tracker) -> Callable[[], None]:
            return lambda: run_empty(empty_plan(nodes, next(numbers)), store, tracker)

        known = empty_plan(nodes, -1)
        runs = {
            "computed, no tracker": fresh(bare, NullTracker()),
            "computed, MLflow tracker": fresh(store, tracker),
            "found finished, MLflow tracker": lambda: run_empty(known, store, tracker),
        }
        seconds = median_seconds(runs, repetitions)
        tracker.close("FINISHED")
    return seconds


def report(nodes: int = 40, repetitions: int = 3) -> str:
    """Measure with and without MLflow; a Markdown table.

    Args:
        nodes: Per plan, an even number.
        repetitions: Timings per row, the median counts.

    Raises:
        RuntimeError: A node failed.
    """
    seconds = seconds_per_plan(nodes, repetitions)
    rows = [[name, f"{1e3 * value / nodes:,.1f}"] for name, value in seconds.items()]
    return markdown(["empty node", "ms per node"], rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pipeline", description=__doc__)
    parser.add_argument("--nodes", type=int, default=40)
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    print(report(options.nodes, options.repetitions))
    print(f"\n{computer()}")


if __name__ == "__main__":
    main()
