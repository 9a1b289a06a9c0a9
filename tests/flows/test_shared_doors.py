"""The doors of a sweep whose store is a URL, from two machines."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flows import tune_models
from flows.configuration.checking import SettingsError, build_config
from flows.configuration.settings import load_settings
from flows.pipeline.driver import DriverRecord
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.places import CACHE, copy_of, glance_of
from flows.report.__main__ import load_report_settings, report
from flows.status.__main__ import load_status_words, status
from flows.status.sweeps import SweepWords
from flows.stop import load_stop_words, stop
from flows.verify import load_verify_settings, verify
from tests.conftest import ROOT

SWEEP = ("profile=smoke", "algorithms=[bc]", "seeds=[0]", "sweep=doors")
RUNNER = ("runner.executor=serial", "runner.tracker=file")


@pytest.mark.slow(20)
def test_doors_find_a_sweep_behind_a_url(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"file://{tmp_path}/shared"
    door = [sys.executable, "-m", "flows.full_benchmark", *SWEEP, *RUNNER, f"store={url}"]
    environment = os.environ | {CACHE: str(tmp_path / "one"), "RAY_ADDRESS": ""}
    done = subprocess.run(door, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{url}/" in done.stderr
    assert f"python -m flows.report sweep=doors store={url}" in done.stdout

    monkeypatch.setenv(CACHE, str(tmp_path / "two"))
    word = f"store={url}"
    assert status(load_status_words([word, "--json"])) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["sweep"], told["state"]) == ("doors", "ended")
    assert len(told["results"]) == 1
    glanced = glance_of(copy_of(url))
    large = [file for file in (glanced / "nodes").rglob("*") if file.stat().st_size > 64 * 1024]
    assert not large
    assert not copy_of(url).joinpath("nodes").exists()

    with pytest.raises(SettingsError, match="No driver of sweep doors runs"):
        stop(load_stop_words([word]))

    assert report(load_report_settings([word, "format=markdown"])) == 0
    assert "1 of 1 cells of the table are finished." in capsys.readouterr().out
    assert verify(load_verify_settings([word])) == 0
    assert "Nothing is damaged." in capsys.readouterr().out


def test_a_driver_elsewhere_is_asked_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The driver's own record, as it sends it; it reads the request as any other object."""
    import time
    from dataclasses import asdict

    url = f"file://{tmp_path}/shared"
    monkeypatch.setenv(CACHE, str(tmp_path / "two"))
    now = time.time()
    record = DriverRecord("far", "an-id", "python -m it", "another-machine", 1, now, now)
    objects = Objects(url)
    objects.write("drivers/far.json", json.dumps(asdict(record)).encode())
    content = json.dumps({"format_version": 1, "name": "far", "command": "it", "nodes": {}})
    objects.write("sweeps/far.json", content.encode())
    assert stop(load_stop_words([f"store={url}", "sweep=far"])) == 0
    assert "on another-machine (process 1) is asked to stop" in capsys.readouterr().out
    assert objects.read("drivers/far.stop") == b"an-id"


@pytest.mark.parametrize(
    ("store", "sentence"),
    [
        ("s3://user:password@host/x", "may not hold a password; put credentials into the env"),
        (f"s3://bucket/{'x' * 300}", "is too long; choose a shorter prefix"),
        ("", "store= is empty; name a folder"),
    ],
)
def test_addresses_that_are_none(store: str, sentence: str) -> None:
    with pytest.raises(SettingsError, match=sentence):
        load_settings([f"store={store}"])
    with pytest.raises(SettingsError, match=sentence):
        build_config(SweepWords, "", {"store": store})


def test_a_search_wants_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE, str(tmp_path))
    with pytest.raises(SettingsError, match=r"give store=FOLDER in place of store=file:///shared"):
        tune_models._run(load_settings(["store=file:///shared", "profile=smoke"]))
