"""What all tests share: their order, which of them stay in one process, a store of a smoke run."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest

# Before torch is imported: two processes with spinning threads take fifty times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Tests end processes, not the power: nothing has to reach the disk, and many waits are saved.
os.fsync = lambda handle: None

ROOT = Path(__file__).parents[1]
# Files whose tests one process runs: they share what is costly to make, or each start Ray on all
# cores. The mark xdist_group does nothing here: pytest 9.2 ignores the name pytest-xdist 3.8 sets.
TOGETHER = {
    "tests/flows/pipeline/executors/test_ray.py": "ray",
    "tests/flows/pipeline/remote/test_cluster.py": "ray",
    "tests/flows/tuning/test_ray.py": "ray",
    "tests/flows/status/test_toy_sweep.py": "ray",
    "tests/flows/status/test_status_of_a_benchmark.py": "ray",
    "tests/flows/planning/test_cells.py": "ray",
    "tests/flows/test_corruption.py": "ray",
    "tests/flows/test_full_benchmark.py": "ray",
    "tests/flows/test_mlflow_pages.py": "ray",  # they share the smoke run
    "tests/test_notebooks.py": "ray",
    "tests/components/reporting/test_page.py": "a browser",
    "tests/flows/console/test_pages.py": "a console",
    "tests/flows/report/test_report_door.py": "ray",
    "tests/flows/report/test_judged_report.py": "a judged sweep",
    "tests/flows/pipeline/tracking/test_mlflow_tracker.py": "an empty database",
    "tests/flows/pipeline/tracking/test_mlflow_places.py": "an empty database",
    "tests/flows/pipeline/tracking/test_mlflow_refusals.py": "an empty database",
    "tests/flows/pipeline/tracking/test_mlflow_leftovers.py": "an empty database",
    "tests/flows/pipeline/tracking/test_mlflow_board.py": "an empty database",
    "tests/flows/tuning/test_tuned_models.py": "tuned models",
}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand out test by test, but the files above whole."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return TOGETHER.get(nodeid.partition("::")[0], nodeid)

    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start the longest tests first, so that no worker is left with one at the end.

    Files that stay together count as one test: theirs keep their order.
    """

    def marked(item: pytest.Item) -> float:
        marker = item.get_closest_marker("slow")
        return float(marker.args[0]) if marker else 0.0

    def group(item: pytest.Item) -> str:
        return TOGETHER.get(item.nodeid.partition("::")[0], item.nodeid)

    seconds: Counter[str] = Counter()
    for item in items:
        seconds[group(item)] += marked(item)
    items.sort(key=lambda item: seconds[group(item)], reverse=True)  # stable


class SmokeRun(NamedTuple):
    """What a whole smoke run left behind.

    Attributes:
        store: its store, which no test may write to.
        printed: its standard output.
    """

    store: Path
    printed: str


@pytest.fixture(scope="session")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> SmokeRun:
    """A smoke run of all algorithms by the benchmark's own door, in this process alone.

    One process runs all tests that need it.
    """
    store = tmp_path_factory.mktemp("smoke") / "mlruns"
    words = ("profile=smoke", "sweep=smoke", "runner.executor=serial", f"store={store}")
    done = subprocess.run(
        [sys.executable, "-m", "flows.full_benchmark", *words],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != "MLFLOW_TRACKING_URI"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return SmokeRun(store, done.stdout)
