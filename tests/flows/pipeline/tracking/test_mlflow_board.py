"""The leaderboard: flat runs, each once, with listed models; prepared views of experiments."""

import base64
import io
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from components.core.integrity import load_json
from components.core.sealed import content_digest, read_record
from flows import ui
from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.json_lines import read_lines
from flows.pipeline.plan import Node, Plan, digest
from flows.pipeline.progress import Display
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.board import Entry, Row, View
from flows.pipeline.tracking.board_tracker import BoardTracker
from flows.pipeline.tracking.file_tracker import FileTracker
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_board import MlflowBoard
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.mlflow_views import saved_views, view_tags
from tests.flows.pipeline.toys import count, counted, node
from tests.flows.pipeline.tracking.sweeps import small

pytestmark = pytest.mark.slow(1)


class Toys:
    """A row for every toy that adds up; counts how often it is read."""

    def __init__(self, log: Path) -> None:
        self.log = log

    def entry(self, node: Node, folder: Path) -> Entry | None:
        if "total" not in node.task:
            return None
        content = content_digest(read_record(folder)) or ""
        return Entry(digest({"toy": node.key}), content, lambda: self.row(node, folder))

    def row(self, node: Node, folder: Path) -> Row:
        count(str(self.log), "rows-read")
        value = load_json(folder / "value.json")
        return Row(
            name="toy.1/total/seed0",
            params={"seed": "0"},
            metrics={"return/mean": [(0, value)], "over/mean": [(0, 1.0), (100, 2.0)]},
            note="A toy.",
            datasets=load_json(folder / "datasets.json"),
            nodes={"policy": node.inputs["a"], "evaluation": node},
            model="policy",
            tags={"kind": "toy"},
        )

    def views(self) -> Sequence[View]:
        return [
            View("all", "All toys", columns=("params.seed",), bars=("return/mean",)),
            View("nodes", "All nodes", "tags.role = 'node'", board=False),
        ]


def sweep(home: Path, tracker: Any, nodes: list[Node], name: str = "first") -> Outcome:
    recorded = BoardTracker(tracker, Toys(home.parent / "log"))
    plan = Plan(nodes)
    recorded.open(name, plan=plan)
    display = Display(Console(file=io.StringIO()))
    outcome = run_plan(plan, ArtifactStore(home), recorded, display, executor=SerialExecutor())
    recorded.close(outcome.status)
    return outcome


def rows(tracker: MlflowTracker) -> list[Any]:
    return list(tracker.board.experiment.search("tags.role = 'row'"))


def models(tracker: MlflowTracker) -> list[Any]:
    experiment = tracker.board.experiment
    return list(experiment.client.search_logged_models([experiment.id]))


def test_a_row_is_a_flat_run_that_leads_to_its_nodes(home: Path) -> None:
    nodes, tracker = small(home), MlflowTracker(home)
    assert sweep(home, tracker, nodes).exit_code == 0
    [row] = rows(tracker)
    assert (row.info.run_name, row.info.status) == ("toy.1/total/seed0", "FINISHED")
    assert "mlflow.parentRunId" not in row.data.tags
    assert row.data.params == {"seed": "0"}
    assert row.data.metrics == {"return/mean": 2.0, "over/mean": 2.0}
    assert {"kind": "toy", "sweep.first": "listed"}.items() <= row.data.tags.items()
    [read] = row.inputs.dataset_inputs
    assert read.dataset.name == "toy"
    ids = {r.data.tags["key"]: r for r in tracker.experiment.search("tags.role = 'node'")}
    note = row.data.tags["mlflow.note.content"]
    for made in (nodes[0], nodes[0].inputs["a"]):
        page = f"#/experiments/{tracker.experiment.id}/runs/{ids[made.key].info.run_id}"
        assert f"[{made.name}]({page}?workflowType=machine_learning)" in note
        assert f"({page}/artifacts?workflowType=machine_learning)" in note

    [parent] = tracker.experiment.search("tags.role = 'sweep'")
    assert (
        "searchFilter=tags.%60sweep.first%60%20%3D%20%27listed%27"
        in (parent.data.tags["mlflow.note.content"])
    )

    [model] = models(tracker)
    assert (model.name, model.status) == ("toy_1_total_seed0", "READY")
    assert model.source_run_id == ids[nodes[0].inputs["a"].key].info.run_id
    assert model.params == {"seed": "0"}
    [number] = model.metrics
    assert (number.key, number.value, number.dataset_name) == ("return/mean", 2.0, "toy")
    assert [out.model_id for out in row.outputs.model_outputs] == [model.model_id]
    assert not list((home / "artifacts").glob("models*"))  # its files are the policy's


def test_sweeps_that_find_a_row_mark_it_and_read_it_no_more(home: Path) -> None:
    for name in ("first", "first", "second"):
        tracker = MlflowTracker(home)
        assert sweep(home, tracker, small(home), name).exit_code == 0
    [row] = rows(tracker)
    assert {tag for tag in row.data.tags if tag.startswith("sweep.")} == {
        "sweep.first",
        "sweep.second",
    }
    assert row.data.tags["sweep"] == "first"
    assert len(models(tracker)) == 1
    parents = tracker.experiment.search("tags.role = 'sweep'")
    assert [len(parent.inputs.dataset_inputs) for parent in parents] == [0, 1]
    assert counted(home.parent / "log", "rows-read") == 1


def test_another_result_of_a_node_takes_the_place_of_its_row(home: Path) -> None:
    nodes, tracker = small(home), MlflowTracker(home)
    sweep(home, tracker, nodes)
    about = rows(tracker)[0].data.tags["about"]
    folder = ArtifactStore(home).path(nodes[0].key)
    made = Toys(home.parent / "log").row(nodes[0], folder)
    for _ in range(2):
        again = MlflowTracker(home)
        again.open("first", plan=Plan(nodes))
        again.log_entry(Entry(about, "other bytes", lambda: made))
        again.close("FINISHED")
        [row], [model] = rows(again), models(again)
        assert row.data.tags["content"] == "other bytes"
        assert [out.model_id for out in row.outputs.model_outputs] == [model.model_id]


def test_a_row_that_a_killed_driver_left_half_written_is_written_again(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    tracker = MlflowTracker(home)
    tracker.board  # noqa: B018  - opened before the kill
    monkeypatch.setattr(tracker.board.experiment.client, "log_outputs", killed)
    assert sweep(home, tracker, small(home)).exit_code == 130
    assert [row.info.status for row in rows(tracker)] == ["RUNNING"]
    assert [model.status for model in models(tracker)] == ["PENDING"]

    again = MlflowTracker(home)
    assert sweep(home, again, small(home)).exit_code == 0
    assert [row.info.status for row in rows(again)] == ["FINISHED"]
    assert [model.status for model in models(again)] == ["READY"]


def test_a_leaderboard_that_is_refused_loses_no_result_and_is_written_at_the_end(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker, log, calls = MlflowTracker(home), MlflowBoard.log, []

    def refused_once(self: MlflowBoard, *words: Any) -> None:
        calls.append(words)
        if len(calls) == 1:
            raise TrackingError("MLflow is away.")
        log(self, *words)

    monkeypatch.setattr(MlflowBoard, "log", refused_once)
    outcome = sweep(home, tracker, small(home))
    assert (outcome.exit_code, len(outcome.finished), len(calls)) == (0, 2, 2)
    assert len(rows(tracker)) == 1
    assert len(list(tracker.experiment.search("tags.role = 'node'"))) == 2


def test_a_store_without_rows_gets_no_leaderboard(home: Path) -> None:
    tracker = MlflowTracker(home)
    tracker.open("first", plan=Plan([node("number", "one", home.parent / "log", number=1)]))
    tracker.close("FINISHED")
    found = tracker.experiment.client.search_experiments()
    assert {experiment.name for experiment in found} == {"Default", "proximity-bench"}


def test_experiments_open_as_model_training_and_keep_what_people_have_written(home: Path) -> None:
    experiment = MlflowExperiment(home)
    assert experiment.entity().tags["mlflow.experimentKind"] == "custom_model_development"
    experiment.client.set_experiment_tag(experiment.id, "mlflow.note.content", "mine")
    assert MlflowExperiment(home).entity().tags["mlflow.note.content"] == "mine"


def test_views_are_saved_once_and_replaced_when_they_change(home: Path) -> None:
    experiment = MlflowExperiment(home)
    view = View("data-bad-0.4", "One", "params.dataset = 'bad-0.4'", ("metrics.a/b",), lines=("l",))
    experiment.prepare([view])
    tags = experiment.entity().tags
    assert saved_views(tags) == {"data-bad-0.4": "One"}
    assert view_tags([view], tags) == {}
    assert list(view_tags([View("data-bad-0.4", "Two")], tags)) == [
        "mlflow.sharedViewState.data-bad-0.4"
    ]
    packed = json.loads(tags["mlflow.sharedViewState.data-bad-0.4"])["state"]
    state = json.loads(zlib.decompress(base64.b64decode(packed.removeprefix("deflate;"))))
    assert state["searchFilter"] == "params.dataset = 'bad-0.4'"
    assert state["selectedColumns"] == ["metrics.`a/b`"]
    assert [chart["metricKey"] for chart in state["compareRunCharts"]] == ["l"]


def test_the_ui_prints_the_leaderboard_and_every_view(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep(home, MlflowTracker(home), small(home))
    experiments = ui._experiments(StoreAddress(home))
    page = "http://127.0.0.1:5001/#/experiments/{}/runs?workflowType=machine_learning"
    view = "&viewStateShareKey={}&compareRunsMode=CHART"
    assert ui._links(5001, *experiments) == [
        f"Runs: {page.format(1)}",
        f"Leaderboard: {page.format(2)}",
        f"  All toys: {page.format(2)}{view.format('all')}",
        f"  All nodes: {page.format(1)}{view.format('nodes')}",
    ]
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{home}/other.db")
    assert ui._links(5001, *ui._experiments(StoreAddress(home))) == ["Runs: http://127.0.0.1:5001"]


def test_views_that_people_have_shared_without_a_name_are_not_listed() -> None:
    assert saved_views({"mlflow.sharedViewState.a": "deflate;xyz", "other": "{}"}) == {}


def test_rows_are_lines_of_the_file_tracker(home: Path) -> None:
    for _ in range(2):
        assert sweep(home, FileTracker(home), small(home)).exit_code == 0
    events = read_lines(home / "tracking" / "first.jsonl")
    [row] = [event for event in events if event["event"] == "row"]
    assert row["name"] == "toy.1/total/seed0"
    assert row["metrics"] == {"return/mean": [[0, 2.0]], "over/mean": [[0, 1.0], [100, 2.0]]}
    assert row["nodes"]["evaluation"] == small(home)[0].key
