"""What the plan of a benchmark is called, and what it needs."""

from pathlib import Path

import pytest

from flows.configuration.settings import load_settings
from flows.pipeline.schedule import form_groups
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.planning.benchmark import benchmark_plan
from flows.planning.cells import cells_line
from flows.planning.memory import least_stored, needs
from flows.status.grid import cells
from flows.status.sweep_state import SweepState
from tests.conftest import SmokeRun

OF = "cells (datasets x algorithms x seeds)"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            [],
            f"19 x 12 x 5 = 1,140 {OF}: the thesis's 19 x 10 x 5 = 950, and beside them 190 of bc, "
            "lion.",
        ),
        (
            ["profile=quick"],
            f"4 x 4 x 2 = 32 {OF}: the thesis's 4 x 2 x 2 = 16, and beside them 16 of bc, lion.",
        ),
        (["profile=quick", "algorithms=[lion]"], f"4 x 1 x 2 = 8 {OF}."),
        (["profile=quick", "algorithms=[td3_bc]"], f"4 x 1 x 2 = 8 {OF}."),
        (
            ["profile=quick", "algorithms=[bc]", "datasets=[bad-0.0]", "seeds=[3]"],
            f"1 x 1 x 1 = 1 {OF.replace('cells', 'cell')}.",
        ),
        (
            ["profile=quick", "algorithms=[mopo]", "mopo_penalties=[0.1,0.2,0.3]"],
            f"4 x 3 x 2 = 24 {OF}.",
        ),
    ],
)
def test_cells_are_named_as_such(words: list[str], said: str) -> None:
    settings = load_settings(words)
    plan = benchmark_plan(settings)
    assert cells_line(settings, plan) == said
    state = SweepState(SweepRecord.of("some", "", plan), plan, None, "unknown", frozenset())
    counted = cells(state)["total"]
    assert f"= {counted:,} cell" in said, "the sweep's status counts the same ones"


def test_disk_and_memory_are_told_beside_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 2**31}))
    plan = benchmark_plan(load_settings(["profile=quick", "algorithms=[td3_bc]", "seeds=[0]"]))
    groups = form_groups(plan, [n.key for n in plan], ArtifactStore(tmp_path, create=False))
    said = needs(groups, 2**34, tmp_path / "none")
    # Four logs of 3.8 MiB, and of each twenty policies of 180 x 256 x 256 x 3 weights.
    assert said.startswith("Disk: at least 49.4 MiB needed, 2 GiB free. Memory of a task: at least")
    assert said.endswith(", the largest, of 16 GiB.")


@pytest.mark.slow(3)
def test_what_is_needed_at_least_is_no_more_than_what_is_taken(smoke: SmokeRun) -> None:
    store = ArtifactStore(smoke.store, create=False)
    for node in benchmark_plan(load_settings(["profile=smoke"])):
        files = store.record(node.key)["files"].values()
        assert least_stored(node) <= sum(file["size"] for file in files), node.name
