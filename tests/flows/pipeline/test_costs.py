"""Expected times: an overhead and a rate, learned on the same kind of device alone."""

import time
from pathlib import Path
from typing import Any

import pytest

from flows.pipeline.costs import RULES, CostModel, Measurement
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import TaskContext
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.toys import node


def record(kind: str, seconds: float, **more: Any) -> dict[str, Any]:
    """A record of a call of one node that was planned to cost 2."""
    own = {"component": "toys", "tags": {"algorithm": kind}, "cost": 2.0, "seconds": seconds}
    return own | {"share": 1.0, "cost_rules": RULES} | more


def nodes(kind: str, *costs: float, component: str = "toys") -> list[Node]:
    return [node(kind, f"n{cost}", Path(), cost=cost, component=component) for cost in costs]


def test_unknown_nodes_take_the_median_of_their_component_and_then_the_plan_s_word() -> None:
    costs = CostModel([record("total", 10.0), record("other", 2.0), record("other", 2.0)])
    assert costs.seconds(nodes("total", 3.0)) == 15.0
    assert costs.seconds([]) == 0.0
    # Between 5 and 1 seconds per unit of cost; how often each was measured does not matter.
    assert costs.seconds(nodes("number", 3.0)) == 9.0
    assert costs.seconds(nodes("number", 3.0, component="new")) == 3.0
    assert costs.knows("toys", "other")
    assert not costs.knows("toys", "number")


def test_a_small_budget_s_overhead_is_not_scaled_up() -> None:
    # 2 units of work took 4 of 10 seconds, so 500 units take 1,000 seconds, not 2,500
    costs = CostModel([record("total", 10.0, steady_seconds=4.0)])
    assert costs.seconds(nodes("total", 500.0)) == 1006.0
    assert costs.seconds(nodes("total", 250.0, 250.0)) == 1006.0  # one call, one overhead


def test_outliers_do_not_move_it_and_old_times_go() -> None:
    costs = CostModel([record("total", 4.0)] * 3 + [record("total", 4000.0)])
    assert costs.seconds(nodes("total", 1.0)) == 2.0
    for _ in range(50):
        costs.learn(record("total", 8.0))
    assert costs.seconds(nodes("total", 1.0)) == 4.0


@pytest.mark.parametrize(
    "changed",
    [
        {"resumed": True},
        {"cost_rules": RULES - 1},
        {"seconds": -3600.0},
        {"cost": 0.0},
    ],
)
def test_what_is_no_measurement_teaches_nothing(changed: dict[str, Any]) -> None:
    assert not CostModel([record("total", 4.0) | changed]).measured


def test_next_to_nothing_tells_what_a_call_takes_and_no_pace() -> None:
    small = [record("total", seconds, cost=0.001) for seconds in (6.0, 7.0, 8.0)]
    costs = CostModel(small)
    assert not costs.measured
    assert costs.seconds(nodes("number", 0.1, 3.0)) == 10.1  # one call of 7, and the plan's word
    assert costs.seconds(nodes("number", 3.0, component="new")) == 3.0
    costs.learn(record("total", 10.0, steady_seconds=4.0))
    assert costs.seconds(nodes("number", 2.0)) == 10.0, "a pace that was measured comes first"


def test_time_in_which_others_had_the_processor_does_not_count() -> None:
    costs = CostModel([record("total", 10.0, steady_seconds=8.0, cpu_seconds=5.0)])
    assert costs.seconds(nodes("total", 2.0)) == 5.0
    assert costs.seconds(nodes("total", 20.0)) == 41.0
    on_a_gpu = [record("total", 10.0, cpu_seconds=5.0, device="cuda")]
    assert CostModel(on_a_gpu, "cuda").seconds(nodes("total", 2.0)) == 10.0


def test_only_the_same_kind_of_device_counts_and_the_same_model_first() -> None:
    found = [
        record("total", 10.0, software={"device": "old"}),
        record("total", 4.0, software={"device": "new"}),
        record("total", 1.0, device="cuda", software={"device": "card"}),
    ]
    assert CostModel(found, "cpu", "new").seconds(nodes("total", 1.0)) == 2.0
    assert CostModel(found, "cpu", "unseen").seconds(nodes("total", 1.0)) == 3.5
    assert CostModel(found, "cuda", "card").seconds(nodes("total", 1.0)) == 0.5
    missing = CostModel(found[:2], "cuda", "card")
    assert missing.seconds(nodes("total", 3.0)) == 3.0
    assert "nothing in this store was measured on a GPU" in missing.source
    assert CostModel().source == "a rough guess"
    assert CostModel(found).source == "from measured times"


def test_lanes_are_interpolated_between_those_that_were_measured() -> None:
    def measured(lanes: int, seconds: float) -> Measurement:
        return Measurement(
            component="toys", kind="total", lanes=lanes, cost=float(lanes), seconds=seconds
        )

    costs = CostModel()
    costs.add(measured(5, 10.0))
    assert costs.seconds(nodes("total", *[1.0] * 80)) == 160.0  # nothing better is known
    costs.add(measured(80, 85.0))
    for lanes, seconds in ((1, 6.0), (5, 10.0), (20, 25.0), (80, 85.0), (160, 165.0)):
        assert costs.seconds(nodes("total", *[1.0] * lanes)) == pytest.approx(seconds)
    costs.add(measured(40, 90.0))  # a card under load: more lanes never make it faster
    assert costs.seconds(nodes("total", *[1.0] * 160)) == pytest.approx(85.0)


def test_the_pace_of_a_task_leaves_out_what_comes_before_and_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    context = TaskContext(work=tmp_path)
    context.begin()
    assert context.steady_seconds is None
    for when, fraction in ((130.0, 0.1), (132.0, 0.2), (146.0, 0.9), (148.0, 1.0), (400.0, 1.0)):
        now = when
        context.progress(fraction)
    assert context.steady_seconds == pytest.approx(20.0)
    context = TaskContext(work=tmp_path)
    context.begin()
    for when, fraction in ((410.0, 0.0), (420.0, 0.0), (440.0, 1.0)):
        now = when
        context.progress(fraction)
    assert context.steady_seconds == 30.0, "preparations grow with the budget, too"
    context = TaskContext(work=tmp_path)
    context.begin()
    context.validated(0.5, loss=1.0)
    context.progress(0.6)
    assert context.steady_seconds is None, "seen over too small a part of the work"


def test_finished_nodes_say_what_later_estimates_need(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "mlruns")
    made = [node("number", f"n{i}", tmp_path, lanes="both", number=i, cost=3.0) for i in range(2)]
    run_plan(Plan(made), store, NullTracker(), Display(), executor=SerialExecutor())
    for stored in store.records():
        found = Measurement.of_record(stored)
        assert found is not None
        assert (found.component, found.kind, found.lanes, found.cost) == ("toys", "number", 2, 6.0)
        assert found.device == "cpu"
        assert found.model
        assert found.seconds + found.overhead == pytest.approx(
            min(stored["wall_seconds"], stored["cpu_seconds"])
        )
