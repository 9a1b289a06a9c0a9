"""`kill -9` of the driver in front of every step it takes, then the same plan again."""

import subprocess
import sys
from pathlib import Path

import pytest


def points(what: str, folder: Path) -> list[str]:
    command = [sys.executable, "-m", "tests.flows.pipeline.crash_points", what, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow(12)
def test_driver_killed_at_every_change_of_the_disk(tmp_path: Path) -> None:
    *problems, last = points("disk", tmp_path)
    assert problems == []
    assert int(last.removeprefix("points: ")) > 60  # fewer would mean the hook sees nothing


@pytest.mark.slow(25)
def test_driver_killed_at_every_call_of_mlflow(tmp_path: Path) -> None:
    *problems, last = points("tracker", tmp_path)
    assert problems == []
    assert int(last.removeprefix("points: ")) > 15  # fewer would mean the wrappers see nothing
