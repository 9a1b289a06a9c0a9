"""What all tests share: the order in which they start, and one store of a whole smoke run."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start the longest tests first, so that no worker is left with one at the end."""

    def seconds(item: pytest.Item) -> float:
        marker = item.get_closest_marker("slow")
        return float(marker.args[0]) if marker else 0.0

    items.sort(key=seconds, reverse=True)  # stable: tests of a module stay together


class SmokeRun(NamedTuple):
    """What a whole smoke run left behind.

    Attributes:
        store: its store, which nobody may write to.
        words: its settings, but for the executor and the store.
        printed: its standard output.
    """

    store: Path
    words: tuple[str, ...]
    printed: str


@pytest.fixture(scope="session")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> SmokeRun:
    """A smoke run by the benchmark's own door; its tests form the group `ray`, one worker's.

    A learner with lambda, one without, one with updates before its budget, one that draws
    candidates.
    """
    store = tmp_path_factory.mktemp("smoke") / "mlruns"
    words = ("profile=smoke", "algorithms=[lion,td3_bc,brac,bcq]", "sweep=smoke")
    how = ("runner.executor=serial", f"store={store}")
    done = subprocess.run(
        [sys.executable, "-m", "flows.full_benchmark", *words, *how],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != "MLFLOW_TRACKING_URI"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return SmokeRun(store, words, done.stdout)
