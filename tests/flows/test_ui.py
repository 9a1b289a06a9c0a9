"""The UI's door: what it refuses, what it waits for, and that its server ends whole."""

import http.client
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows import ui
from flows.pipeline.errors import TrackingError
from flows.pipeline.tracking import mlflow_ui
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_ui import UiServer, runs_address
from tests.flows.pipeline.toys import wait_for

# Answers like a server of the experiment whose number and place it is given, with a child.
SERVER = """
import http.server, json, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
print("child", child.pid, "password", file=open(sys.argv[3], "w"), flush=True)
class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(sys.argv[2].encode())
http.server.HTTPServer(("127.0.0.1", int(sys.argv[1])), Handler).serve_forever()
"""


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


def door(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["ui", *words])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    try:
        ui.main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.mark.parametrize("number", ["99999", "0", "-1", "x", "1e3", "²"])
def test_what_is_no_port_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: str
) -> None:
    assert door(monkeypatch, f"--port={number}") == 2
    out, err = capsys.readouterr()
    assert (out, err.splitlines()[-1]) == (
        "",
        f"flows.ui: error: argument --port: {number} is no port; give a number from 1 to 65535.",
    )


@pytest.mark.parametrize("made", [False, True])
def test_a_folder_without_runs_is_refused_and_left_as_it_is(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    made: bool,
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    if made:
        (tmp_path / "runs").mkdir()
    assert door(monkeypatch, f"--store={tmp_path}/runs") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "runs holds no runs of MLflow; name their folder with --store FOLDER" in err
    assert [p.name for p in tmp_path.rglob("*")] == ["runs"] * made


def test_a_server_of_the_user_is_named_without_its_secrets(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "https://me:p@ss@host:1/x?token=hunter2")
    assert door(monkeypatch) == 0
    assert "open https://host:1/x?token=*** in a browser" in capsys.readouterr().out


def test_a_taken_port_is_one_sentence_and_no_link(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    taken: int,
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/other.db")
    assert door(monkeypatch, f"--port={taken}") == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"ui: Port {taken} of this computer cannot be used (Address already in")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def server_that_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, answer: object) -> None:
    def command(port: int) -> list[str]:
        words = [str(port), json.dumps(answer), str(tmp_path / "said")]
        return [sys.executable, "-c", SERVER, *words]

    monkeypatch.setattr(mlflow_ui, "_command", command)


def ended(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"  # its new parent may not have asked for it yet


def child(tmp_path: Path) -> int:
    return int((tmp_path / "said").read_text().split()[1])


def test_the_server_ends_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int
) -> None:
    ours = SimpleNamespace(experiment_id="7", artifact_location="file:///here")
    server_that_answers(monkeypatch, tmp_path, {"experiment": vars(ours)})
    with UiServer(StoreAddress(tmp_path), port, ours):
        assert not ended(child(tmp_path))
    wait_for(lambda: ended(child(tmp_path)), "the server's child")


def test_a_server_of_another_store_is_not_taken_for_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int
) -> None:
    ours = SimpleNamespace(experiment_id="7", artifact_location="file:///here")
    other = {"experiment_id": "7", "artifact_location": "file:///there"}
    server_that_answers(monkeypatch, tmp_path, {"experiment": other})
    monkeypatch.setattr(mlflow_ui, "_START", 0.5)
    with (
        pytest.raises(TrackingError, match=f"server on port {port} did not start"),
        UiServer(StoreAddress(tmp_path), port, ours),
    ):
        raise AssertionError("it was taken for ours")


def test_a_server_that_dies_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "postgresql://me:hunter2@host/x")
    dies = "import os; print('no', os.environ['MLFLOW_BACKEND_STORE_URI'])"
    monkeypatch.setattr(mlflow_ui, "_command", lambda port: [sys.executable, "-c", dies])
    with (
        pytest.raises(TrackingError, match=r"\(it said: no postgresql://host/x\)"),
        UiServer(StoreAddress(tmp_path), port),
    ):
        raise AssertionError("there was a server")


def test_the_list_of_runs_has_an_address() -> None:
    assert runs_address(5001, None) == "http://127.0.0.1:5001"
    found = runs_address(5001, SimpleNamespace(experiment_id="3"))
    assert found.startswith("http://127.0.0.1:5001/#/experiments/3/runs")
    command = mlflow_ui._command(5001)
    assert command[command.index("--host") + 1] == "127.0.0.1"


@pytest.mark.slow(15)
def test_links_to_files_work_after_a_move_and_a_signal_ends_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    from flows.pipeline.tracking.mlflow_tracker import MlflowTracker

    old, new = tmp_path / "old", tmp_path / "new%2F ö"
    tracker = MlflowTracker(old)
    tracker.open("killed")  # and never closed
    run_id = tracker.sweep.run_id
    assert run_id is not None
    tracker.experiment.client.log_text(run_id, "hello", "deep/file.txt")
    tracker.sweep._lock.close()
    old.rename(new)
    words = ["-m", "flows.ui", f"--store={new}", f"--port={port}"]
    with subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        link = process.stdout.readline()
        assert link.startswith(f"Runs: http://127.0.0.1:{port}/#/experiments/1/runs")
        connection = http.client.HTTPConnection("127.0.0.1", port)
        connection.request("GET", f"/get-artifact?run_uuid={run_id}&path=deep/file.txt")
        assert connection.getresponse().read() == b"hello"
        connection.request("GET", f"/api/2.0/mlflow/runs/get?run_id={run_id}")
        told = json.loads(connection.getresponse().read())["run"]["info"]
        assert told["status"] == "KILLED"
        connection.close()
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate()
    assert process.returncode == 143
    assert "Traceback" not in err
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))
    assert not old.exists()
