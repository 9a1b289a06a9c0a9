"""The whole benchmark by its own door, killed and continued."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from components.reporting.tables import COLUMNS
from tests.flows.pipeline.toys import wait_for

# A learner with lambda, one without, one with updates before its budget, one that draws candidates.
CHOSEN = "algorithms=[lion,td3_bc,brac,bcq]"
ROOT = Path(__file__).parents[2]


def start(store: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "flows.full_benchmark",
            "profile=smoke",
            CHOSEN,
            f"store={store}",
            *words,
        ],
        cwd=ROOT,
        env=os.environ | {"RAY_ADDRESS": "", "MLFLOW_TRACKING_URI": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def results(store: Path) -> str:
    (table,) = store.glob("reports/*/results.csv")
    return table.read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_killed_ray_sweep_ends_with_the_numbers_of_a_serial_one(tmp_path: Path) -> None:
    with start(tmp_path / "serial", "runner.executor=serial") as run:
        table, messages = run.communicate(timeout=300)
    assert run.returncode == 0, messages
    expected = results(tmp_path / "serial")
    rows = list(csv.DictReader(expected.splitlines()))
    assert tuple(rows[0]) == COLUMNS
    # LION at proximity 0, 0.5 and 1, and the others.
    assert [row["proximity"] for row in rows] == ["0.0", "0.5", "1.0", "", "", ""]
    assert table.startswith("| dataset")

    killed = tmp_path / "killed"
    nodes = killed / "nodes"
    for finished in (1, 4, 8):  # of 23 nodes: during data, models and policies, evaluation
        with start(killed) as run:
            wait_for(
                lambda n=finished: nodes.is_dir() and len([*nodes.glob("[!.]*")]) >= n,
                f"{finished} finished nodes",
            )
            run.kill()
    with start(killed) as run:
        _, messages = run.communicate(timeout=300)
    assert run.returncode == 0, messages
    assert results(killed) == expected
