"""The lines that a sweep writes into its file, each once."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.json_lines import append_line, mend_last_line, read_lines
from flows.pipeline.locks import locked
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.file_tracker import FileTracker
from tests.flows.pipeline.damage import damage
from tests.flows.pipeline.toys import node


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "log").mkdir()
    return tmp_path / "mlruns"


def small(home: Path) -> list[Node]:
    log = home.parent / "log"
    source = node("number", "source", log, number=2)
    return [node("total", "last", log, {"a": source})]


def run(home: Path, nodes: list[Node], sweep: str = "first", **params: Any) -> Outcome:
    tracker, plan = FileTracker(home), Plan(nodes)
    tracker.open(sweep, {"profile": "toy"}, params, plan)
    with (home.parent / "screen").open("w") as file:
        display = Display(Console(file=file))
        outcome = run_plan(plan, ArtifactStore(home), tracker, display, executor=SerialExecutor())
    tracker.close(outcome.status, [home / "results.csv"], {"loss": [(0, float("nan"))]})
    return outcome


def lines(home: Path, sweep: str = "first") -> list[dict[str, Any]]:
    return read_lines(home / "tracking" / f"{sweep}.jsonl")


def test_sweep_and_nodes_are_recorded_without_mlflow(home: Path) -> None:
    nodes = small(home)
    assert run(home, nodes, seeds="0,1").exit_code == 0
    begun, source, last, ended = lines(home)
    assert [line["event"] for line in (begun, source, last, ended)] == [
        "open", "node", "node", "close",
    ]  # fmt: skip
    assert begun["tags"] == {"profile": "toy"}
    assert begun["params"] == {"seeds": "0,1"}
    assert begun["nodes"] == {"toys": 2}
    assert (last["about"], last["name"], last["component"]) == (nodes[0].key, "last", "toys")
    assert last["inputs"] == {"a": source["about"]}
    assert last["metrics"] == {"value": 2.0}
    assert last["tags"]["algorithm"] == "total"
    assert (home / last["folder"] / "value.json").exists()
    assert last["time"] >= last["finished"] - 0.001 >= last["started"] - 0.001
    assert ended["status"] == "FINISHED"
    assert ended["files"] == ["results.csv"]  # of the store, wherever it is moved
    assert not (home / "mlflow.db").exists()
    assert list((home / "locks").iterdir()) == []


def test_the_same_sweep_again_adds_no_line(home: Path) -> None:
    run(home, small(home))
    before = (home / "tracking" / "first.jsonl").read_text()
    assert len(run(home, small(home)).reused) == 2
    assert (home / "tracking" / "first.jsonl").read_text() == before
    # Another sweep lists the nodes that it has reused.
    run(home, small(home), "second")
    assert [line["about"] for line in lines(home, "second")] == [
        line["about"] for line in lines(home)
    ]


def test_failure_and_later_success_are_two_lines(home: Path) -> None:
    bad = node("fails", "bad", home.parent / "log", number=1)
    for _ in range(2):
        assert run(home, [bad]).exit_code == 1
    begun, failed, ended = lines(home)[:3]
    assert (begun["event"], failed["event"], ended["status"]) == ("open", "failure", "FAILED")
    assert failed["reason"].endswith("ValueError: this toy fails on purpose")
    (home.parent / "log" / "repaired").touch()
    assert run(home, [bad]).exit_code == 0
    *_, finished, ended = lines(home)
    assert (finished["event"], finished["about"]) == ("node", bad.key)
    assert ended["status"] == "FINISHED"
    assert [line["event"] for line in lines(home)].count("node") == 1


def test_a_line_that_a_killed_writer_left_half_is_written_again(home: Path) -> None:
    run(home, small(home))
    file = home / "tracking" / "first.jsonl"
    whole = lines(home)
    content = file.read_text().splitlines(keepends=True)
    file.write_text("".join(content[:2]) + content[2][:30])
    run(home, small(home))
    assert [line["about"] for line in lines(home)] == [line["about"] for line in whole]


def test_a_damaged_file_is_named_with_the_remedy(home: Path) -> None:
    (home / "tracking").mkdir(parents=True)
    (home / "tracking" / "first.jsonl").write_text("no json\n")
    with pytest.raises(TrackingError, match=r"line 1 of .*first\.jsonl is no JSON.*repair or rem"):
        run(home, small(home))


def test_a_file_that_cannot_be_opened_is_named(home: Path) -> None:
    (home / "tracking").mkdir(parents=True)
    (home / "tracking" / "first.jsonl").mkdir()
    with pytest.raises(TrackingError, match=r"first\.jsonl cannot be used \(Is a directory\)"):
        FileTracker(home).open("first")
    assert list((home / "locks").iterdir()) == []


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "lines.jsonl"
    append_line(file, {"a": 1})
    script = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from flows.pipeline.json_lines import append_line\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20, 20))\n"
        "try: append_line(Path(sys.argv[1]), {'b': 'x' * 100})\n"
        "except OSError as error: print(error.strerror)"
    )
    command = [sys.executable, "-c", script, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() in ("No space left on device", "File too large")
    assert read_lines(file) == [{"a": 1}]


def test_half_lines_are_cut_and_whole_files_stay(tmp_path: Path) -> None:
    file = tmp_path / "lines.jsonl"
    mend_last_line(file)
    assert read_lines(file) == []
    file.write_text('{"a": 1}\n{"b"')
    mend_last_line(file)
    assert file.read_text() == json.dumps({"a": 1}) + "\n"
    mend_last_line(file)
    assert read_lines(file) == [{"a": 1}]


def test_what_only_lacks_its_end_is_ended_and_what_is_foreign_stays(tmp_path: Path) -> None:
    file = tmp_path / "lines.jsonl"
    file.write_text('{"a": 1}\n{"b": 2}')
    mend_last_line(file)
    assert read_lines(file) == [{"a": 1}, {"b": 2}]
    file.write_bytes(b"SQLite format 3\x00\n and more")
    before = file.read_bytes()
    with pytest.raises(ValueError, match=r"line 2 of .*lines\.jsonl is no JSON object"):
        mend_last_line(file)
    assert file.read_bytes() == before


def test_numbers_that_are_not_finite_are_words(home: Path) -> None:
    tracker = FileTracker(home)
    for _ in range(2):
        tracker.open("first")
        tracker.close("FINISHED", metrics={"loss": [(0, float("inf")), (1, float("nan"))]})
    text = (home / "tracking" / "first.jsonl").read_text()
    _, ended = (json.loads(line, parse_constant=pytest.fail) for line in text.splitlines())
    assert ended["metrics"] == {"loss": [[0, None], [1, None]]}


def test_two_processes_do_not_run_one_sweep(home: Path) -> None:
    (home / "locks").mkdir(parents=True)
    with (
        locked(home / "locks" / "sweep-first.lock"),
        pytest.raises(TrackingError, match="Another process is running the sweep 'first'"),
    ):
        FileTracker(home).open("first")


def test_sweep_name_may_not_leave_the_folder(home: Path) -> None:
    with pytest.raises(ValueError, match="letters, digits"):
        FileTracker(home).open("../first")


def test_nothing_is_written_without_an_open_sweep(home: Path) -> None:
    tracker = FileTracker(home)
    tracker.close("FINISHED")
    with pytest.raises(TrackingError, match="No sweep is open"):
        tracker.log_failure(small(home)[0], "why")
    assert not home.exists()


def test_a_node_that_was_made_again_to_other_bytes_is_another_result(home: Path) -> None:
    log = home.parent / "log"
    one = node("number_of_a_file", "one", log)
    for number, made in (("3", 1), ("3", 1), ("4", 2)):
        (log / "number").write_text(number)
        damage(ArtifactStore(home).path(one.key) / "value.json", "flipped") if made == 2 else None
        assert run(home, [one]).exit_code == 0
        recorded = [line["metrics"]["value"] for line in lines(home) if line["event"] == "node"]
        assert recorded == [3.0, 4.0][:made]
