"""A real driver in another process: looked at, stopped, killed, continued."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from components.core.files import read_json
from flows.configuration.checking import SettingsError
from flows.pipeline.driver import driving
from flows.pipeline.outcome import STOPPED
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.status.__main__ import load_status_words, status
from flows.stop import load_stop_words, stop
from tests.conftest import ROOT
from tests.flows.pipeline.test_runner import run
from tests.flows.pipeline.toys import counted, node, wait_for
from tests.flows.status.toy_driver import COMMAND, HOLD, NAME, main, toy_plan


@contextmanager
def driver(
    store: ArtifactStore, log: Path, kind: str = "serial"
) -> Iterator[subprocess.Popen[str]]:
    """Drives the toy sweep up to the step at which it holds."""
    words = [sys.executable, "-m", "tests.flows.status.toy_driver", store.root, log, kind]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_for(lambda: counted(log, "holding") or process.poll() is not None, "the hold")
            yield process
        finally:
            process.kill()


def told(store: ArtifactStore, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert status(load_status_words([f"store={store.root}", *words])) == 0
    return capsys.readouterr().out


def values(store: ArtifactStore, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(told(store, capsys, "--json"))
    return found


def files(store: ArtifactStore) -> set[Path]:
    return set(store.root.rglob("*"))


def ask(store: ArtifactStore) -> int:
    return stop(load_stop_words([f"store={store.root}", f"sweep={NAME}"]))


@pytest.mark.slow(8)
def test_a_running_sweep_is_told_from_outside_and_a_killed_one_is_none(
    store: ArtifactStore, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with driver(store, log) as process:
        before = files(store)
        # The worker reports twice a second; the toys hold at a step behind the first report.
        found = wait_for(lambda: v if (v := values(store, capsys))["running"] else None, "a report")
        assert (found["state"], found["driver"]["pid"]) == ("running", process.pid)
        assert found["nodes"] == {"total": 9, "done": 2, "running": 3, "failed": 0, "skipped": 0}
        [call] = found["running"]
        assert call["pid"] == process.pid
        assert 0.0 <= call["fraction"] <= HOLD / 20
        assert call["remaining_seconds"] >= 0.0
        assert found["components"]["train"]["running"] == 3
        text = told(store, capsys)
        assert "2 of 9 nodes are finished" in text
        assert f"running on {found['driver']['host']} (process {process.pid})" in text
        assert " and 2 more" in text
        assert files(store) == before, "looking leaves nothing"
    found = values(store, capsys)
    assert (found["state"], found["running"]) == ("killed", [])
    assert found["nodes"]["done"] == 2
    assert "sum" in found["missing"]
    assert f"no driver runs; its driver on {found['driver']['host']}" in told(store, capsys)
    with pytest.raises(SettingsError, match="No driver of sweep toys runs; there is nothing"):
        ask(store)

    (log / "go").touch()
    assert main(store.root, log, "serial") == 0
    assert told(store, capsys).startswith("Sweep toys: finished.\n")
    assert read_json(store.path(toy_plan(log).nodes[-1].key) / "value.json") == 240.0
    with pytest.raises(SettingsError, match="No driver of sweep toys runs"):
        ask(store)


@pytest.mark.slow(8)
@pytest.mark.parametrize("kind", ["serial", "ray"])
def test_a_driver_that_is_asked_to_stop_does_so_at_a_checkpoint(
    kind: str, store: ArtifactStore, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with driver(store, log, kind) as process:
        assert ask(store) == 0
        assert f"Continue with: {COMMAND}" in capsys.readouterr().out
        if kind == "ray":  # the driver is another process, and may be slower than eight short steps
            asked = (store.root / "progress").glob
            wait_for(lambda: list(asked("*.pause")), "the driver to ask its workers")
        (log / "go").touch()
        _, messages = process.communicate(timeout=120)
        assert process.returncode == STOPPED, messages
    assert "Stopping, since flows.stop asked for it" in messages
    assert f"nothing finished is lost. Continue with: {COMMAND}" in messages
    assert [f for f in files(store) if f.suffix in (".stop", ".pause")] == []
    assert list((store.root / "progress").iterdir()) == []
    [begun, *_] = store.begun().values()
    assert HOLD / 20 <= begun < 1.0
    assert "since flows.stop asked for it. Continue with: make it so" in told(store, capsys)

    assert main(store.root, log, "serial") == 0, "the request does not reach the next driver"
    assert read_json(store.path(toy_plan(log).nodes[-1].key) / "value.json") == 240.0
    for name in ("s00", "s11"):
        assert counted(log, f"step-{name}") == 20, "no step was lost"


@pytest.mark.slow(4)
def test_a_second_driver_is_told(store: ArtifactStore, log: Path) -> None:
    with driver(store, log), driver(store, log) as second:
        _, messages = second.communicate(timeout=60)
    assert "Another process is running the sweep 'toys'" in messages
    assert counted(log, "drivers") == 1


def test_failures_are_told_with_what_they_keep_from_running(
    store: ArtifactStore, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = node("fails", "bad", log, number=1)
    nodes = [node("total", "needs", log, {"a": bad}), node("number", "good", log, number=1)]
    SweepRecord.of(NAME, COMMAND, Plan(nodes)).save(store.root)
    with driving(store, NAME, COMMAND) as driver:
        driver.status = run(nodes, store, driver=driver).status
    found = values(store, capsys)
    assert [f["node"] for f in found["failed"]] == ["bad"]
    error = found["failed"][0]["error"]
    assert error.startswith("ValueError: this toy fails on purpose (")  # and where
    assert found["skipped"] == [{"node": "needs", "needs": "bad"}]
    assert found["missing"] == []
    text = told(store, capsys)
    assert f"failed bad: {error}" in text
    assert "1 failed, 1 cannot run without these" in text
