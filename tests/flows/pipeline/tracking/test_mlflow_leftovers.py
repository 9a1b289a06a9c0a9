"""What killed sweeps left open is closed; giving a sweep again adds nothing; odd numbers."""

import math
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.locks import locked
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.mlflow_writes import split_finite
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.tracking.sweeps import run, runs, small

pytestmark = pytest.mark.slow(1)


def left_open(tracker: MlflowTracker, name: str, **tags: str) -> str:
    """A run as a process leaves it that is killed."""
    experiment = tracker.experiment
    made = experiment.client.create_run(
        experiment.id, start_time=1000, run_name=name, tags=experiment.common | tags
    )
    return str(made.info.run_id)


def states(tracker: MlflowTracker) -> dict[str, tuple[str, int | None]]:
    found = tracker.experiment.search("")
    return {run.info.run_name: (run.info.status, run.info.end_time) for run in found}


def test_whoever_opens_the_store_closes_what_killed_processes_left(home: Path) -> None:
    tracker = MlflowTracker(home)
    dead = left_open(tracker, "dead", role="sweep", sweep="dead")
    left_open(tracker, "silent", role="sweep", sweep="silent")
    left_open(tracker, "alive", role="sweep", sweep="alive")
    left_open(tracker, "half", role="node", key="k")
    left_open(tracker, "trial", role="trial", study="s", trial="3")
    left_open(tracker, "someone's", colour="blue")
    child = left_open(tracker, "child", **{"mlflow.parentRunId": dead, "role": "node"})
    tracker.experiment.client.set_terminated(child, "FINISHED", end_time=5000)
    with locked(home / "locks" / "sweep-alive.lock"):
        MlflowExperiment(home)
    assert states(tracker) == {
        "dead": ("KILLED", 5000),  # when it was last seen alive
        "silent": ("KILLED", 1000),
        "alive": ("RUNNING", None),
        "half": ("KILLED", 1000),
        "child": ("FINISHED", 5000),
        "someone's": ("RUNNING", None),
    }
    assert [path.name for path in (home / "locks").iterdir()] == []


def test_what_a_server_refused_in_the_middle_is_closed_by_the_driver_that_goes_on(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker, [last] = MlflowTracker(home), small(home)
    tracker.open("first", plan=Plan([last]))
    with open(os.devnull, "w", encoding="utf-8") as null:
        run_plan(
            Plan([last]),
            ArtifactStore(home),
            NullTracker(),
            Display(Console(file=null)),
            executor=SerialExecutor(),
        )

    def away(*_: Any, **__: Any) -> None:
        raise ConnectionError("the server was killed")

    source, folder = last.inputs["a"], ArtifactStore(home).path
    with monkeypatch.context() as patch:
        patch.setattr(tracker.experiment.client, "set_terminated", away)
        with pytest.raises(TrackingError):
            tracker.log_node(source, folder(source.key))
    assert states(tracker)[source.name] == ("RUNNING", None)
    tracker.log_node(source, folder(source.key))
    tracker.close("FINISHED")
    found = {run.info.status for run in runs(tracker, "node")}
    assert (len(runs(tracker, "node")), found) == (2, {"KILLED", "FINISHED"})


def test_a_killed_sweep_given_again_is_finished(home: Path) -> None:
    left_open(MlflowTracker(home), "first", role="sweep", sweep="first")
    _, tracker = run(home, small(home))
    assert [r.info.status for r in runs(tracker, "sweep")] == ["FINISHED"]


def test_runs_of_other_stores_in_a_shared_database_are_left_alone(
    home: Path, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(database, home.parent / "shared.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{home.parent}/shared.db")
    for store in ("one", "two"):
        tracker = MlflowTracker(home.parent / store)
        left_open(tracker, store, role="sweep", sweep=store)
        left_open(tracker, f"node of {store}", role="node", key=store)
    MlflowExperiment(home.parent / "two")
    assert {name: state for name, (state, _) in states(tracker).items()} == {
        "one": "RUNNING",
        "node of one": "RUNNING",
        "two": "KILLED",
        "node of two": "KILLED",
    }


def history(tracker: MlflowTracker, name: str) -> list[tuple[int, float]]:
    (parent,) = runs(tracker, "sweep")
    points = tracker.experiment.client.get_metric_history(parent.info.run_id, name)
    return [(point.step, point.value) for point in points]


def test_a_sweep_given_again_adds_no_metric_twice(home: Path) -> None:
    curve: dict[str, list[tuple[int, float]]] = {"best": [(0, 3.0), (1, 2.0)]}
    for _ in range(3):
        tracker = MlflowTracker(home)
        tracker.open("first")
        tracker.close("FINISHED", metrics=curve)
    assert history(tracker, "best") == [(0, 3.0), (1, 2.0)]
    tracker.open("first")
    tracker.close("FINISHED", metrics={"best": [(0, 3.0), (1, 1.5), (2, 1.0)]})
    assert history(tracker, "best") == [(0, 3.0), (1, 2.0), (1, 1.5), (2, 1.0)]


def test_numbers_that_are_not_finite_are_named_and_not_drawn(home: Path) -> None:
    tracker = MlflowTracker(home)
    tracker.open("first")
    odd: dict[str, Any] = {"a": [(0, math.inf)], "b": [(0, 1.0), (1, math.nan), (2, -math.inf)]}
    tracker.close("FINISHED", metrics=odd)
    (parent,) = runs(tracker, "sweep")
    assert parent.data.metrics == {"b": 1.0}
    assert parent.data.tags["not_finite"] == "a: inf, b: -inf/nan at 2 of 3 steps"
    tracker.open("first")
    tracker.close("FINISHED", metrics={"a": [(0, 2.0)]})
    (parent,) = runs(tracker, "sweep")
    assert parent.data.metrics == {"a": 2.0, "b": 1.0}
    assert "not_finite" not in parent.data.tags


def test_finite_numbers_stay_as_they_are() -> None:
    points = [("a", 1.0, 7, 0), ("a", 1.7e308, 8, 1)]
    assert split_finite(points) == (points, "")
