"""The whole benchmark by its own door, killed and continued."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from components.reporting.tables import COLUMNS
from tests.conftest import ROOT, SmokeRun
from tests.flows.pipeline.toys import wait_for

# With a proximity, without one, with updates before the budget, with drawn candidates.
CHOSEN = ("lion", "td3_bc", "brac", "bcq")


def start(store: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "flows.full_benchmark", *words, f"store={store}"],
        cwd=ROOT,
        env=os.environ | {"RAY_ADDRESS": "", "MLFLOW_TRACKING_URI": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def results(store: Path) -> list[dict[str, str]]:
    """The rows of the chosen algorithms, as text."""
    (table,) = store.glob("reports/*/results.csv")
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    return sorted(
        (row for row in rows if row["algorithm"] in CHOSEN),
        key=lambda row: (CHOSEN.index(row["algorithm"]), row["proximity"]),
    )


@pytest.mark.slow(70)
def test_a_killed_ray_sweep_ends_with_the_numbers_of_a_serial_one(
    smoke: SmokeRun, tmp_path: Path
) -> None:
    expected = results(smoke.store)
    assert tuple(expected[0]) == COLUMNS
    # LION at proximity 0, 0.5 and 1, and the others.
    assert [row["proximity"] for row in expected] == ["0.0", "0.5", "1.0", "", "", ""]
    assert smoke.printed.startswith("dataset ")

    words = ("profile=smoke", f"algorithms=[{','.join(CHOSEN)}]", "sweep=smoke")
    killed = tmp_path / "killed"
    nodes = killed / "nodes"
    for finished in (1, 4, 8):  # of 23 nodes: during data, models and policies, evaluation
        with start(killed, *words) as run:
            wait_for(
                lambda n=finished: nodes.is_dir() and len([*nodes.glob("[!.]*")]) >= n,
                f"{finished} finished nodes",
            )
            run.kill()
    with start(killed, *words) as run:
        _, messages = run.communicate(timeout=300)
    assert run.returncode == 0, messages
    assert results(killed) == expected
