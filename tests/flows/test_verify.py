"""`flows.verify` on stores of toys: what is damaged, what is an orphan, and what pruning leaves."""

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from components.core.files import read_json, write_json
from components.core.sealed import RECORD
from components.reporting.stored import ReportNodes
from flows.configuration.checking import SettingsError
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.verification.orphans import freed_bytes
from flows.verify import load_verify_settings, verify
from tests.flows.grid import finished
from tests.flows.pipeline.toys import node
from tests.flows.pipeline.tracking.test_mlflow_board import models, rows, sweep

COMMAND = "python -m flows.full_benchmark sweep=first"


@pytest.fixture
def plan(log: Path) -> Plan:
    source = node("number", "source", log, number=1)
    return Plan([node("total", "sum", log, inputs={"a": source})])


@pytest.fixture
def store(tmp_path: Path, plan: Plan) -> ArtifactStore:
    """A finished sweep of two nodes, with its record."""
    store = finished(plan, tmp_path / "mlruns")
    SweepRecord("first", COMMAND, {node.key: node.name for node in plan}).save(store.root)
    return store


def run(store: ArtifactStore, *words: str) -> int:
    return verify(load_verify_settings([f"store={store.root}", *words]))


def keys(plan: Plan) -> dict[str, str]:
    return {node.name: node.key for node in plan}


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def begun_work(store: ArtifactStore, key: str, age: float = 0.0) -> Path:
    work = store.open_work([key])
    write_json(work.path / "checkpoint.json", {"step": 1})
    then = time.time() - age
    for file in work.path.iterdir():
        os.utime(file, (then, then))
    return work.path


def test_a_whole_store_is_said_to_be_whole(
    store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(store) == 0
    said = capsys.readouterr().out
    assert "2 finished artifacts, 1 recorded sweeps" in said
    assert said.endswith("Nothing is damaged.\n")


@pytest.mark.parametrize("name", ["value.json", "deep/blob.bin", "curves.npz", RECORD])
@pytest.mark.parametrize("how", ["flipped", "truncated", "missing"])
def test_every_damaged_file_is_named_with_the_command_that_makes_it_again(
    name: str, how: str, store: ArtifactStore, plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    path = store.path(keys(plan)["source"]) / name
    if how == "flipped":
        flip(path)
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[:-2])
    else:
        path.unlink()
    assert run(store) == 1
    said = capsys.readouterr().out
    assert f"damaged: {path}" in said
    assert f"It is source; make it again with: {COMMAND}" in said
    assert "Nothing is damaged" not in said


def test_a_folder_under_another_key_is_damaged(
    store: ArtifactStore, plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    key = keys(plan)["source"]
    store.path(key).rename(store.nodes / "another")
    assert run(store) == 1
    assert f"another/node.json is that of {key}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("sweeps/first.json", "{"),
        ("reports/first/report.json", '{"format_version": 1}'),
        ("tracking/first.jsonl", "no json\n"),
        ("optuna/journal.log", "[1]\n"),
        ("mlflow.db", "no database"),
        ("mlflow.db", ""),
    ],
)
def test_damaged_records_are_named_and_nothing_is_pruned_while_they_are(
    name: str, content: str, store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    path = store.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    (store.root / "artifacts" / "run").mkdir(parents=True)
    work = begun_work(store, "f" * 32)
    assert run(store, "--prune") == 1
    said = capsys.readouterr().out
    assert "damaged: " in said
    assert str(path) in said
    assert "Nothing is removed" in said
    assert work.is_dir()


def test_a_record_that_is_still_json_is_no_longer_what_was_written(
    store: ArtifactStore, plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    key = keys(plan)["sum"]
    report = store.root / "reports" / "first"
    report.mkdir(parents=True)
    ReportNodes((key,), {"plant": key}).save(report)
    assert ReportNodes.load(report).aggregations == (key,)
    for path in (report / "report.json", store.root / "sweeps" / "first.json"):
        written = path.read_text()
        path.write_text(written.replace(key, "f" * 32))
        assert run(store, "--prune") == 1
        said = capsys.readouterr().out
        assert f"damaged: {path} cannot be used because its content is not what was written" in said
        assert store.complete(key)
        path.write_text(written)
    assert run(store) == 0


@pytest.mark.parametrize("name", ["members.json", "checkpoint.safetensors"])
def test_damaged_work_is_named_and_keeps_nothing_from_being_pruned(
    name: str, store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    SweepRecord("second", "the command", {"e" * 32: "lion/plant/seed0"}).save(store.root)
    other = begun_work(store, "f" * 32)
    work = begun_work(store, "e" * 32)
    (work / name).write_text("{")
    assert run(store, "--prune") == 1
    said = capsys.readouterr().out
    assert f"damaged: {work}" in said
    assert ("with: the command" in said) == (name == "checkpoint.safetensors")
    assert not other.exists()
    assert work.is_dir()


def test_work_of_no_recorded_sweep_is_named_and_then_pruned(
    store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    work = begun_work(store, "f" * 32)
    assert run(store) == 0
    assert f"orphan: work, node {'f' * 32}: in no recorded sweep" in capsys.readouterr().out
    assert work.is_dir()
    assert run(store, "--prune") == 0
    assert "1 removed" in capsys.readouterr().out
    assert not work.exists()
    assert run(store) == 0
    assert "orphan" not in capsys.readouterr().out


def test_work_of_a_sweep_stays_until_it_is_old(
    store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    SweepRecord("second", "…", {"f" * 32: "lion/plant/seed0"}).save(store.root)
    work = begun_work(store, "f" * 32, age=10 * 86400.0)
    assert run(store, "--prune") == 0
    assert work.is_dir()
    assert run(store, "--prune", "days=9") == 0
    assert "lion/plant/seed0: untouched for 10 days" in capsys.readouterr().out
    assert not work.exists()


def test_what_a_process_is_at_work_on_stays(
    store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    work = begun_work(store, "f" * 32)
    with store.locked(["f" * 32]):
        assert run(store, "--prune") == 0
    assert "kept: node" in capsys.readouterr().out
    assert work.is_dir()


def test_nothing_is_pruned_while_a_sweep_uses_the_store(
    store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    work = begun_work(store, "f" * 32)
    with store_in_use(store):
        assert run(store, "--prune") == 0
    assert "a sweep is using the store" in capsys.readouterr().out
    assert work.is_dir()
    assert run(store, "--prune") == 0
    assert "Orphans: 1 of kind work; 1 removed" in capsys.readouterr().out
    assert not work.exists()


def test_a_link_is_removed_and_what_it_leads_to_stays(store: ArtifactStore, tmp_path: Path) -> None:
    aside = tmp_path / "elsewhere"
    aside.mkdir()
    (aside / "file").write_text("kept")
    (store.root / "damaged").mkdir()
    (store.root / "damaged" / "link").symlink_to(aside)
    assert run(store, "--prune") == 0
    assert list((store.root / "damaged").iterdir()) == []
    assert (aside / "file").read_text() == "kept"


def test_work_that_was_never_begun_is_a_leftover(store: ArtifactStore) -> None:
    for name, age in (("old", 2 * 86400.0), ("young", 0.0)):
        folder = store.work / f".{name}"
        folder.mkdir()
        os.utime(folder, (time.time() - age,) * 2)
    assert run(store, "--prune") == 0
    assert [folder.name for folder in store.work.iterdir()] == [".young"]


def test_artifacts_of_no_sweep_are_pruned_and_those_that_others_read_stay(
    store: ArtifactStore, plan: Plan, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Plan([node("number", "other", log, number=5)])
    finished(other, store.root)
    # The record names the sum alone: what it was made from is needed, too.
    SweepRecord("first", COMMAND, {keys(plan)["sum"]: "sum"}).save(store.root)
    assert run(store, "--prune") == 0
    assert "orphan: artifact, other: in no recorded sweep" in capsys.readouterr().out
    assert {path.name for path in store.nodes.iterdir()} == set(keys(plan).values())


def test_artifacts_stay_where_runs_are_kept_elsewhere(
    store: ArtifactStore,
    plan: Plan,
    log: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:1")
    finished(Plan([node("number", "other", log, number=5)]), store.root)
    assert run(store, "--prune") == 0
    assert "1 artifacts of no recorded sweep or report are kept" in capsys.readouterr().out
    assert len(list(store.nodes.iterdir())) == 3


def test_artifacts_that_a_report_or_an_event_names_stay(
    store: ArtifactStore, plan: Plan, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (store.root / "sweeps" / "first.json").unlink()
    report = store.root / "reports" / "first" / "report.json"
    report.parent.mkdir(parents=True)
    write_json(
        report,
        {"format_version": 1, "aggregations": [keys(plan)["sum"]], "datasets": {}},
    )
    other = Plan([node("number", "other", log, number=5)])
    finished(other, store.root)
    events = store.root / "tracking" / "first.jsonl"
    events.parent.mkdir()
    events.write_text(json.dumps({"event": "node", "about": next(iter(other)).key}) + "\n")
    assert run(store) == 0
    assert "orphan" not in capsys.readouterr().out


def test_older_artifacts_get_digests_on_request(
    store: ArtifactStore, plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = store.path(keys(plan)["source"])
    record = read_json(folder / RECORD)
    write_json(folder / RECORD, {k: v for k, v in record.items() if k not in ("files", "digest")})
    flip(folder / "value.json")
    assert run(store) == 0
    assert "1 artifacts were made without digests" in capsys.readouterr().out
    assert run(store, "--seal") == 0
    assert "1 artifacts of an older version have digests now" in capsys.readouterr().out
    flip(folder / "value.json")
    assert run(store) == 1


def test_a_line_that_is_being_written_is_no_damage(store: ArtifactStore) -> None:
    for name in ("tracking/first.jsonl", "optuna/journal.log"):
        path = store.root / name
        path.parent.mkdir()
        path.write_text('{"event": "open", "about": "open"}\n{"event": "no')
    assert run(store) == 0


@pytest.mark.slow(6)
def test_runs_without_artifacts_and_files_without_runs(
    tmp_path: Path, plan: Plan, store: ArtifactStore, capsys: pytest.CaptureFixture[str]
) -> None:
    tracker = MlflowTracker(store.root)
    tracker.open("first", plan=plan)
    for made in plan:
        tracker.log_node(made, store.path(made.key))
    tracker.close("FINISHED")
    stray = store.root / "artifacts" / ("0" * 32)
    stray.mkdir()
    (stray / "file").write_bytes(b"x" * 1000)
    (store.root / "artifacts" / "models" / "m-1").mkdir(parents=True)  # a recorded policy
    gone = store.path(keys(plan)["sum"])
    doomed = tmp_path / "elsewhere"
    gone.rename(doomed)
    # The sweep on record will make it again; without the record nothing will.
    assert run(store) == 0
    said = capsys.readouterr().out
    assert "files of the run 00000000000000000000000000000000, which is gone" in said
    assert "whose artifact" not in said
    (store.root / "sweeps" / "first.json").unlink()
    assert run(store, "--prune") == 0
    said = capsys.readouterr().out
    assert f"whose artifact {gone.name} is gone" in said
    assert not stray.exists()
    left = {run.data.tags.get("key") for run in tracker.experiment.search("tags.role = 'node'")}
    assert left == {keys(plan)["source"]}
    assert len(list((store.root / "artifacts").iterdir())) == 2
    assert (store.root / "artifacts" / "models" / "m-1").is_dir()
    assert run(store) == 0
    assert "orphan" not in capsys.readouterr().out


@pytest.mark.slow(6)
def test_rows_of_the_leaderboard_go_with_their_artifacts(
    tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nodes = [
        node("total", f"sum{n}", log, inputs={"a": node("number", f"source{n}", log, number=n)})
        for n in range(2)
    ]
    store, tracker = ArtifactStore(tmp_path / "mlruns"), MlflowTracker(tmp_path / "mlruns")
    assert sweep(store.root, tracker, nodes).exit_code == 0
    SweepRecord.of("first", COMMAND, Plan(nodes)).save(store.root)
    shutil.rmtree(store.path(nodes[0].key))
    assert run(store) == 0
    assert "orphan" not in capsys.readouterr().out, "its sweep will make it again"
    (store.root / "sweeps" / "first.json").unlink()
    assert run(store) == 0
    said = f"of the leaderboard, whose artifact {nodes[0].key} is gone"
    assert said in capsys.readouterr().out
    assert (len(rows(tracker)), len(models(tracker))) == (2, 2)
    assert run(store, "--prune") == 0
    assert "Orphans: 1 of kind run, 1 of kind row; 2 removed" in capsys.readouterr().out
    [left] = rows(tracker)
    assert left.data.tags["key.evaluation"] == nodes[1].key
    assert [model.tags["key"] for model in models(tracker)] == [nodes[1].inputs["a"].key]
    assert run(store) == 0
    assert "orphan" not in capsys.readouterr().out


def test_freed_bytes_counts_a_file_with_a_second_name_elsewhere_as_nothing(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "file").write_bytes(b"x" * 100)
    os.link(tmp_path / "a" / "file", tmp_path / "b" / "file")
    (tmp_path / "c" / "file").write_bytes(b"y" * 10)
    assert freed_bytes([tmp_path / "a", tmp_path / "c"]) == 10
    assert freed_bytes([tmp_path / "a", tmp_path / "b", tmp_path / "c"]) == 110


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["store=/nowhere"], "store=/nowhere holds no runs"),
        (["prune"], "'prune' is not a setting; write key=value"),
        (["--prune", "prune=false"], "prune is given twice"),
        (["days=-1"], "days"),
        (["--purge"], "'--purge' is not a setting; write key=value"),
        (["--store"], "'--store' is not a setting; write key=value"),
        (["store="], "store= is empty; name a folder"),
    ],
)
def test_bad_words(words: list[str], said: str, store: ArtifactStore) -> None:
    if not words[0].startswith("store"):
        words = [f"store={store.root}", *words]
    with pytest.raises(SettingsError, match=said):
        load_verify_settings(words)
