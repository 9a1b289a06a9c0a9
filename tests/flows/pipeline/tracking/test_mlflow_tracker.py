"""The content of MLflow's database and artifact folder after a sweep."""

import contextlib
import io
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from components.core.files import write_json
from components.core.integrity import SMALL, describe_files
from components.core.sealed import read_record, seal
from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_run import flat, link_tree, read_content
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.damage import damage
from tests.flows.pipeline.toys import node, wait_for
from tests.flows.pipeline.tracking.sweeps import run, runs, small

pytestmark = pytest.mark.slow(1)


def test_sweep_and_nodes_are_recorded(home: Path) -> None:
    outcome, tracker = run(home, small(home))
    assert outcome.exit_code == 0
    (parent,) = runs(tracker, "sweep")
    assert (parent.info.run_name, parent.info.status) == ("first", "FINISHED")
    assert parent.data.params == {"a.b": "[1, 2]", "nodes.toys": "2"}
    assert parent.data.tags["profile"] == "toy"
    assert parent.data.metrics == {"nodes": 2.0}
    assert [
        f.path for f in tracker.experiment.client.list_artifacts(parent.info.run_id, "report")
    ] == ["report/results.csv"]

    # Named once, although two nodes have read it.
    assert [read.dataset.name for read in parent.inputs.dataset_inputs] == ["toy"]

    by_name = {run.info.run_name: run for run in runs(tracker, "node")}
    assert set(by_name) == {"source", "last"}
    last, key = by_name["last"], small(home)[0].key
    record = ArtifactStore(home).record(key)
    expected = {
        "mlflow.parentRunId": parent.info.run_id,
        "component": "toys",
        "dataset": "toy",
        "algorithm": "total",
        "seed": "0",
        "sweep": "first",
        "sweep.first": "computed",
        "key": key,
        "version": "1",
        "colour": "blue",
        "mlflow.source.name": "tests",
    }
    assert expected.items() <= last.data.tags.items()
    assert "source (a)" in last.data.tags["mlflow.note.content"]
    assert last.data.params["list"] == "[1, 2]"
    assert last.data.params["nested.x"] == "null"
    assert last.data.metrics["value"] == 2.0
    assert last.data.metrics["usage/wall_seconds"] == record["wall_seconds"]
    history = tracker.experiment.client.get_metric_history(last.info.run_id, "train/loss")
    assert [(m.step, m.value) for m in history] == [(i, 2.0 + i) for i in range(10)]
    (read,) = last.inputs.dataset_inputs
    assert (read.dataset.name, read.dataset.digest) == ("toy", "d" * 36)
    # In milliseconds; the end is the start and what was measured, whatever the clock has done.
    assert last.info.start_time == int(1000 * record["started"])
    assert last.info.end_time - last.info.start_time == int(1000 * record["wall_seconds"])


def test_a_final_number_stands_at_the_end_of_its_curve(tmp_path: Path) -> None:
    write_json(tmp_path / "node.json", {"started": 1.0, "finished": 2.0})
    write_json(tmp_path / "metrics.json", {"loss": 0.5, "size": 7.0})
    curve = {"loss/step": np.array([10, 20]), "loss/value": np.array([3.0, 1.0])}
    np.savez(tmp_path / "curves.npz", **curve)
    points = [(name, step, value) for name, value, _, step in read_content(tmp_path).metrics]
    assert points == [("loss", 10, 3.0), ("loss", 20, 1.0), ("loss", 20, 0.5), ("size", 0, 7.0)]


def test_artifacts_are_second_names_of_the_stored_files(home: Path) -> None:
    _, tracker = run(home, small(home))
    for recorded in runs(tracker, "node"):
        folder = ArtifactStore(home).path(recorded.data.tags["key"])
        place = home / "artifacts" / recorded.info.run_id / "artifacts"
        for name in ("node.json", "value.json", "deep/blob.bin"):
            assert (place / name).samefile(folder / name)


@pytest.mark.slow(2)
def test_database_is_made_in_wal_mode_after_a_maker_was_killed(bare: Path) -> None:
    bare.mkdir()
    (bare / "mlflow.db").touch()  # an empty file is none
    (bare / "mlflow.db-wal").write_bytes(b"changes of a database that was set aside")
    (bare / ".mlflow-young.db").write_bytes(b"half a database")
    _, tracker = run(bare, small(bare))
    assert len(runs(tracker, "node")) == 2
    with sqlite3.connect(bare / "mlflow.db") as database:
        assert database.execute("pragma journal_mode").fetchone() == ("wal",)
    database.close()
    assert not list(bare.glob(".mlflow-young*"))
    assert (bare / "mlflow.db-wal-aside").read_bytes().startswith(b"changes of")


def test_reuse_marks_the_run_and_makes_no_second_one(home: Path) -> None:
    run(home, small(home))
    run(home, small(home))
    outcome, tracker = run(home, small(home), "second")
    assert len(outcome.reused) == 2
    assert [r.info.run_name for r in runs(tracker, "sweep")] == ["second", "first"]
    nodes = runs(tracker, "node")
    assert len(nodes) == 2
    for recorded in nodes:
        tags = recorded.data.tags
        assert (tags["sweep.first"], tags["sweep.second"]) == ("computed", "reused")
        assert tags["sweep"] == "first"


def test_nodes_finished_but_not_recorded_are_recorded_later(home: Path) -> None:
    nodes = small(home)
    with open(os.devnull, "w", encoding="utf-8") as null:
        store, display = ArtifactStore(home), Display(Console(file=null))
        run_plan(Plan(nodes), store, NullTracker(), display, executor=SerialExecutor())
    outcome, tracker = run(home, nodes)
    assert len(outcome.reused) == 2
    assert {r.info.status for r in runs(tracker, "node")} == {"FINISHED"}
    assert len(runs(tracker, "node")) == 2


def test_failure_is_recorded_and_success_gets_a_run_of_its_own(home: Path) -> None:
    log = home.parent / "log"
    bad = node("fails", "bad", log, number=1)
    outcome, tracker = run(home, [bad])
    assert outcome.exit_code == 1
    (failed,) = runs(tracker, "node")
    assert failed.info.status == "FAILED"
    assert failed.data.tags["error"].startswith("ValueError: this toy fails on purpose (")
    text = (home / "artifacts" / failed.info.run_id / "artifacts" / "traceback.txt").read_text()
    assert "Traceback" in text
    assert runs(tracker, "sweep")[0].info.status == "FAILED"

    (log / "repaired").touch()
    outcome, tracker = run(home, [bad])
    assert outcome.exit_code == 0
    assert {r.info.status for r in runs(tracker, "node")} == {"FAILED", "FINISHED"}
    (parent,) = runs(tracker, "sweep")
    assert parent.info.status == "FINISHED"


def test_runs_a_killed_driver_left_open_are_closed(home: Path) -> None:
    tracker = MlflowTracker(home)
    tags = {"role": "node", "key": small(home)[0].key}
    tracker.experiment.client.create_run(tracker.experiment.id, tags=tags, run_name="half")
    tracker.experiment.client.create_run(
        tracker.experiment.id, tags={"role": "sweep", "sweep": "first"}, run_name="first"
    )
    _, tracker = run(home, small(home))
    states = sorted((r.info.run_name, r.info.status) for r in runs(tracker, "node"))
    assert states == [("half", "KILLED"), ("last", "FINISHED"), ("source", "FINISHED")]
    assert [r.info.status for r in runs(tracker, "sweep")] == ["FINISHED"]


def test_tracking_uri_is_honoured(
    bare: Path, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, other = bare, bare.parent / "other.db"
    shutil.copy(database, other)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{other}")
    _, tracker = run(home, small(home))
    assert not (home / "mlflow.db").exists()
    assert len(runs(tracker, "node")) == 2
    assert len(list((home / "artifacts").iterdir())) == 3


@pytest.mark.parametrize(
    ("uri", "says"),
    [
        ("http://name:secret@127.0.0.1:9", "MLflow at http://127.0.0.1:9 refused"),
        ("sqlite:////dev/null/x.db", "MLflow at sqlite:////dev/null/x.db refused"),
        ("./runs", "MLflow at ./runs refused"),
    ],
    ids=["no server", "no database", "file store"],
)
def test_store_that_cannot_be_reached_is_one_sentence(
    home: Path, monkeypatch: pytest.MonkeyPatch, uri: str, says: str
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(TrackingError) as caught:
        run(home, small(home))
    message = str(caught.value)
    assert message.startswith(says)
    assert "secret" not in message
    assert message.endswith("give the same command again.")
    assert "\n" not in message


@pytest.mark.slow(12)
def test_server_keeps_the_runs_and_their_artifacts(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    there = bare.parent / "server"
    there.mkdir()
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1"]
    command += ["--port", str(port), "--workers", "1"]
    command += ["--backend-store-uri", f"sqlite:///{there}/server.db"]
    command += ["--artifacts-destination", str(there / "files")]
    environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        command, env=environment, cwd=there, stdout=quiet, stderr=quiet, start_new_session=True
    ) as server:
        try:

            def answers() -> bool:
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                    return True
                return False

            wait_for(answers, "the server", 120.0)
            monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{port}")
            _, tracker = run(bare, small(bare))
            (last,) = [r for r in runs(tracker, "node") if r.info.run_name == "last"]
            files = {f.path for f in tracker.experiment.client.list_artifacts(last.info.run_id)}
        finally:
            os.killpg(server.pid, signal.SIGKILL)
    assert {"node.json", "deep", "curves.npz"} <= files
    assert last.info.status == "FINISHED"
    assert not (bare / "mlflow.db").exists()


def test_two_processes_do_not_run_one_sweep(home: Path) -> None:
    script = (
        "import sys; from flows.pipeline.locks import locked; from pathlib import Path\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    tracker = MlflowTracker(home)
    lock = str(home / "locks" / "sweep-first.lock")
    with subprocess.Popen(
        [sys.executable, "-c", script, lock],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(TrackingError, match="Another process is running the sweep 'first'"):
            tracker.open("first")
        other.kill()
    tracker.open("first")
    tracker.close("FINISHED")


def test_sweep_name_may_not_break_searches(home: Path) -> None:
    with pytest.raises(ValueError, match="letters, digits"):
        MlflowTracker(home).open("it's")


def make(folder: Path, **files: Any) -> Callable[[], Any]:
    folder.mkdir()
    write_json(folder / "node.json", {"started": 1.0, "finished": 3.0})
    for name, value in files.items():
        write_json(folder / f"{name}.json", value)
    return lambda: read_content(folder)


def test_long_curves_are_thinned_to_their_ends(tmp_path: Path) -> None:
    read = make(tmp_path / "node", metrics={"a[0]=%": 1.5, "gone": None})
    steps = np.arange(5000)
    np.savez(
        tmp_path / "node" / "curves.npz",
        **{"x/step": steps, "x/value": steps * 2.0, "empty/step": [], "empty/value": []},
    )
    metrics = read().metrics
    curve = [(step, value, at) for name, value, at, step in metrics if name == "x"]
    assert len(curve) == 200
    assert curve[0][:2] == (0, 0.0)
    assert curve[-1] == (4999, 9998.0, 3000)
    # Signs that MLflow refuses become underscores.
    assert [m for m in metrics if m[0] != "x"] == [("a_0___", 1.5, 3000, 0)]


def test_parameters_are_flat_and_short(tmp_path: Path) -> None:
    params = flat({"a": {"b": 1, "c": [1, "x"]}, "long": "y" * 9000, "bad[key]": True})
    assert params["a.b"] == "1"
    assert params["a.c"] == '[1, "x"]'
    assert len(params["long"]) < 6000
    assert params["bad_key_"] == "true"


def test_other_disks_get_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*names: Any) -> None:
        raise OSError(18, "Invalid cross-device link")

    make(tmp_path / "node")
    monkeypatch.setattr(os, "link", refuse)
    link_tree(tmp_path / "node", tmp_path / "copy")
    copy, original = tmp_path / "copy" / "node.json", tmp_path / "node" / "node.json"
    assert copy.read_text() == original.read_text()
    assert not copy.samefile(original)


def test_a_damaged_artifact_is_named_and_the_others_are_recorded(home: Path) -> None:
    log = home.parent / "log"
    nodes = [node("number", f"n{i}", log, number=i) for i in range(3)]
    plan, store, screen = Plan(nodes), ArtifactStore(home), io.StringIO()
    run_plan(plan, store, NullTracker(), Display(Console(file=screen)), executor=SerialExecutor())
    # Its size is as before and nothing has to be made, so only the tracker reads it.
    large = store.path(nodes[1].key) / "curves.npz"
    large.write_bytes(large.read_bytes() + bytes(SMALL))
    seal(large.parent, read_record(large.parent))
    content = describe_files(large.parent)
    tracker = MlflowTracker(home)
    tracker.open("first", plan=plan)

    def log_node(one: Node, folder: Path, log_node: Any = tracker.log_node) -> None:
        if folder == large.parent:
            damage(large, "flipped")
        log_node(one, folder)

    tracker.log_node = log_node  # type: ignore[method-assign]
    outcome = run_plan(
        plan, store, tracker, Display(Console(file=screen)), executor=SerialExecutor(),
        repairs=False,
    )  # fmt: skip
    assert (outcome.exit_code, outcome.unrecorded) == (1, "")
    assert list(outcome.damaged) == [nodes[1].key]
    assert f"{large} is damaged" in screen.getvalue().replace("\n", "")
    assert "MLflow" not in screen.getvalue()
    assert sorted(run.info.run_name for run in runs(tracker, "node")) == ["n0", "n2"]
    assert content != describe_files(large.parent)
    tracker.close("FINISHED")


def test_a_node_that_was_made_again_to_other_bytes_gets_another_run(home: Path) -> None:
    log = home.parent / "log"
    one = node("number_of_a_file", "one", log)
    (log / "number").write_text("3")
    run(home, [one])
    path = ArtifactStore(home).path(one.key) / "value.json"
    for number, expected in (("3", 3.0), ("4", 4.0)):
        (log / "number").write_text(number)
        damage(path, "flipped")
        outcome, tracker = run(home, [one])
        assert (outcome.exit_code, outcome.finished) == (0, [one.key])
        (recorded,) = runs(tracker, "node")
        assert recorded.data.metrics["value"] == expected
        # The run's files are second names of the artifact's, so they were damaged as well.
        (kept,) = home.glob(f"artifacts/{recorded.info.run_id}/artifacts/value.json")
        assert kept.samefile(path)
