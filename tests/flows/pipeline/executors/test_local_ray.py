"""The folder of Ray's own files: short, private, and gone when its driver is."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.local_ray import LocalRay


@pytest.fixture
def base(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.delenv("RAY_TMPDIR", raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def test_the_folder_is_private_and_goes_away(base: Path) -> None:
    local = LocalRay(1)
    (folder,) = base.iterdir()
    assert local.options["_temp_dir"] == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    local.close()
    assert list(base.iterdir()) == []


def test_only_a_dead_driver_s_folder_is_removed(base: Path) -> None:
    hold = """
from flows.pipeline.executors.local_ray import LocalRay

local = LocalRay(1)
print(local.options["_temp_dir"], flush=True)
input()
"""
    words = [sys.executable, "-c", hold]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        theirs = Path(other.stdout.readline().strip())
        local = LocalRay(1)
        assert theirs.is_dir()
        local.close()
        other.kill()
    assert theirs.is_dir()
    (base / "pbray-of-somebody.txt").touch()
    LocalRay(1).close()
    assert [path.name for path in base.iterdir()] == ["pbray-of-somebody.txt"]


def test_a_long_folder_is_replaced_by_a_short_one(
    base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = base / ("long" * 20)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    local = LocalRay(1)
    folder = Path(local.options["_temp_dir"])
    assert folder.parent == Path("/tmp")
    session = f"session_2026-01-01_00-00-00_000000_{2**22}/sockets/plasma_store"
    assert len(os.fsencode(folder / session)) <= 107
    local.close()

    monkeypatch.setattr(
        "flows.pipeline.executors.local_ray._writable", lambda folder: folder != Path("/tmp")
    )
    with pytest.raises(
        PipelineError, match=r"^TMPDIR=/.* is too long for the sockets of Ray: set "
    ):
        LocalRay(1)


@pytest.mark.parametrize("name", ["TMPDIR", "RAY_TMPDIR"])
def test_a_folder_that_is_not_there_is_named(
    name: str, base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, str(base / "none"))
    sentence = f"^{name}={base}/none is no folder that can be written: make it, or unset {name}.$"
    with pytest.raises(PipelineError, match=sentence):
        LocalRay(1)
