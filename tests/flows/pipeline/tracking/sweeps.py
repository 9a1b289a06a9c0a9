"""Toy sweeps with the real MLflow tracker, in this process."""

import os
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.toys import node


def run(home: Path, nodes: list[Node], sweep: str = "first") -> tuple[Outcome, MlflowTracker]:
    tracker = MlflowTracker(home, source="tests")
    plan = Plan(nodes)
    tracker.open(sweep, {"profile": "toy"}, {"a": {"b": [1, 2]}}, plan)
    with open(os.devnull, "w", encoding="utf-8") as null:
        display = Display(Console(file=null))
        outcome = run_plan(plan, ArtifactStore(home), tracker, display, executor=SerialExecutor())
    report = home / "results.csv"
    report.write_text("dataset\n")
    tracker.close(outcome.status, [report], {"nodes": [(0, len(plan))]})
    return outcome, tracker


def runs(tracker: MlflowTracker, role: str) -> list[Any]:
    return list(tracker.experiment.search(f"tags.role = '{role}'"))


def small(home: Path) -> list[Node]:
    log = home.parent / "log"
    source = node("number", "source", log, number=2)
    return [node("total", "last", log, {"a": source}, lanes="", list=[1, 2], nested={"x": None})]
