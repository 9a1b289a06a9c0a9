"""The state of a real benchmark: grid, table, JSON, lists of sweeps, records of older versions."""

import json
from pathlib import Path
from typing import Any

import pytest

from components.algorithms import ALGORITHMS
from flows.pipeline.sweep_records import SweepRecord, known_nodes
from flows.status.__main__ import load_status_words, status
from tests.conftest import SmokeRun


def told(store: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert status(load_status_words([f"store={store}", *words])) == 0
    return capsys.readouterr().out


@pytest.mark.slow(25)
def test_a_finished_benchmark(
    smoke: SmokeRun, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # all algorithms beside each other
    before = set(smoke.store.rglob("*"))
    text = told(smoke.store, capsys)
    assert text.startswith("Sweep smoke: finished.\n")
    wanted = len(ALGORITHMS) * 2
    assert f"\n{wanted} of {wanted} cells and " in text
    shown = text.splitlines()
    grid_row = next(line for line in shown if line.startswith("mediocre-0.2"))
    assert grid_row.split()[1:] == ["2/2"] * len(ALGORITHMS)

    values: dict[str, Any] = json.loads(told(smoke.store, capsys, "--json"))
    assert values["cells"] == {
        "total": wanted, "done": wanted, "running": 0, "failed": 0, "missing": 0
    }  # fmt: skip
    assert values["missing"] == []
    assert {row["algorithm"] for row in values["results"]} == set(ALGORITHMS)
    # Below it stands the table that the sweep itself has printed.
    mine, theirs = (
        [line.split()[:3] for line in said if line.startswith("mediocre-0.2")][at]
        for said, at in ((shown, 1), (smoke.printed.splitlines(), 0))
    )
    assert mine == theirs
    assert set(smoke.store.rglob("*")) == before, "looking leaves nothing"


@pytest.mark.slow(5)
def test_a_record_of_an_older_version_tells_what_it_can(
    smoke: SmokeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nodes = known_nodes(smoke.store, "smoke")
    (tmp_path / "nodes").symlink_to(smoke.store / "nodes")
    SweepRecord("old", "the old command", {**nodes, "f" * 32: "lion/nowhere/seed0"}).save(tmp_path)
    text = told(tmp_path, capsys)
    assert "whether a driver runs is not known. Continue with: the old command" in text
    assert f"{len(nodes)} of {len(nodes) + 1} nodes are finished." in text
    assert "holds no plan" in text
    assert json.loads(told(tmp_path, capsys, "--json"))["missing"] == ["lion/nowhere/seed0"]
