"""Two drivers at once, and clocks that jump: real processes on one store, with a real MLflow."""

import subprocess
import sys
from pathlib import Path

import pytest

from components.core.files import read_json
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.fault_driver import shared_plan
from tests.flows.pipeline.toys import counted, wait_for

_DAY = 24 * 3600.0


def start(home: Path, log: Path, name: str, jump: float = 0.0) -> subprocess.Popen[str]:
    words = ["-m", "tests.flows.pipeline.fault_driver", str(home), str(log), name, str(jump)]
    return subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE, text=True)


def finished_runs(home: Path) -> list:
    found = MlflowTracker(home).experiment.search("tags.role = 'node'")
    return [run for run in found if run.info.status == "FINISHED"]


@pytest.mark.slow(20)
def test_two_drivers_share_the_work_and_a_third_of_the_same_name_is_told(
    tmp_path: Path, log: Path
) -> None:
    home, plan = tmp_path / "shared", shared_plan(log)
    with start(home, log, "one") as one, start(home, log, "other") as other:
        wait_for(lambda: counted(log, "drivers") == 2, "both drivers")
        wait_for(lambda: counted(log, "holding") >= 1, "a group that waits")
        with start(home, log, "one") as third:
            _, said = third.communicate(timeout=300)
        assert third.returncode == 1
        assert said == (
            "Another process is running the sweep 'one': wait for it, stop it, or give this sweep "
            "another name.\n"
        )
        (log / "go").touch()
        ends = [driver.communicate(timeout=300)[1] for driver in (one, other)]
        assert [one.returncode, other.returncode] == [0, 0], ends
    assert read_json(ArtifactStore(home).path(plan.nodes[-1].key) / "value.json") == 240.0
    assert {n.name: counted(log, f"finished-{n.name}") for n in plan} == {n.name: 1 for n in plan}
    runs = finished_runs(home)
    assert sorted(run.data.tags["key"] for run in runs) == sorted(node.key for node in plan)
    for run in runs:  # each sweep knows all of them
        marks = {run.data.tags.get(f"sweep.{name}") for name in ("one", "other")}
        assert marks in ({"computed", "reused"}, {"computed"})


@pytest.mark.slow(12)
@pytest.mark.parametrize("jump", [-_DAY, _DAY])
def test_a_clock_that_jumps_changes_no_result_and_no_duration(
    tmp_path: Path, log: Path, jump: float
) -> None:
    home, plan = tmp_path / "shared", shared_plan(log)
    with start(home, log, "jumps", jump) as driver:
        wait_for(lambda: counted(log, "holding") >= 1, "a group that waits")
        (log / "go").touch()
        _, said = driver.communicate(timeout=300)
    assert driver.returncode == 0, said
    store = ArtifactStore(home)
    assert read_json(store.path(plan.nodes[-1].key) / "value.json") == 240.0
    for node in plan:
        record = store.record(node.key)
        assert 0.0 <= record["wall_seconds"] < 300.0, "the longest that this test can take"
    for run in finished_runs(home):
        assert 0 <= run.info.end_time - run.info.start_time < 300_000
    told = read_json(home / "drivers" / "jumps.json")
    assert (told["ended"], told["running"]) == ("FINISHED", {})
