"""Groups, their order, the estimate, and the display."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from components.core.files import write_json
from components.core.sealed import seal
from flows.pipeline.costs import CostModel
from flows.pipeline.group import GroupResult
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display, duration
from flows.pipeline.run_state import ComponentState, RunState
from flows.pipeline.schedule import Group, form_groups, simulate_schedule
from flows.pipeline.store import ArtifactStore
from tests.flows.pipeline.toys import node, record_of


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "mlruns", create=False)


def fan(log: Path) -> Plan:
    """Two sources of 1 s, on each two lanes of 2 s in all, one sum of 3 s."""
    sources = [node("number", f"n{i}", log, component="data", number=i) for i in range(2)]
    lanes = [
        node("total", f"t{i}{k}", log, {"a": source}, component="train", lanes=f"t{i}", lane=k)
        for i, source in enumerate(sources)
        for k in range(2)
    ]
    inputs = {lane.name: lane for lane in lanes}
    return Plan([node("total", "sum", log, inputs, component="collect", cost=3.0)])


def groups_of(plan: Plan, store: ArtifactStore) -> list[Group]:
    return form_groups(plan, [node.key for node in plan], store)


def test_lanes_form_groups_with_priorities_along_the_chain(
    store: ArtifactStore, tmp_path: Path
) -> None:
    groups = groups_of(fan(tmp_path), store)
    names = [[node.name for node in group.nodes] for group in groups]
    assert names == [["n0"], ["n1"], ["t00", "t01"], ["t10", "t11"], ["sum"]]
    assert [group.priority for group in groups] == [6.0, 6.0, 5.0, 5.0, 3.0]
    assert groups[2].needs == {groups[0].name}
    assert groups[4].needs == {groups[2].name, groups[3].name}


def test_where_there_is_much_to_do_cheap_results_and_what_they_share_come_first(
    store: ArtifactStore, tmp_path: Path
) -> None:
    shared = node("number", "shared", tmp_path, cost=2.0)
    results = [
        node("total", f"r{i}", tmp_path, {"a": node("total", f"p{i}", tmp_path, {"b": shared}, i=i,
             cost=float(30 - i))}, cost=0.1)
        for i in range(30)
    ]  # fmt: skip
    alone = node("number", "alone", tmp_path, cost=1.5)
    plan = Plan([*results, alone])

    def order(slots: int) -> list[str]:
        groups = form_groups(plan, [node.key for node in plan], store, slots)
        ends = simulate_schedule(groups, {g.name: g.priority for g in groups}, slots=1)
        names = {group.name: group.nodes[0].name for group in groups}
        return [names[name] for name in sorted(ends, key=lambda name: ends[name])]

    early = order(slots=1)
    assert early[:6] == ["alone", "shared", "p29", "r29", "p28", "r28"]
    assert early[-2:] == ["p0", "r0"]
    # 465 s on two processors are less than ten chains of 32 s each: the longest chain first.
    assert order(slots=2)[:2] == ["shared", "p0"]


def test_lanes_that_wait_for_themselves_are_refused(store: ArtifactStore, tmp_path: Path) -> None:
    first = node("total", "first", tmp_path, lanes="same")
    between = node("total", "between", tmp_path, {"a": first})
    last = node("total", "last", tmp_path, {"a": between}, lanes="same")
    with pytest.raises(ValueError, match="'same' waits for itself"):
        groups_of(Plan([last]), store)


@pytest.mark.parametrize(("slots", "whole"), [(1, 9.0), (2, 6.0), (8, 6.0)])
def test_estimate_simulates_the_schedule(
    store: ArtifactStore, tmp_path: Path, slots: int, whole: float
) -> None:
    groups = groups_of(fan(tmp_path), store)
    costs = CostModel()
    seconds = {group.name: costs.seconds(group.nodes) for group in groups}
    # By hand: 1 + 1 + 2 + 2 + 3 one after the other; 1 + 2 + 3 with two at once.
    assert max(simulate_schedule(groups, seconds, slots).values()) == whole


class Screen(Display):
    def __init__(self, *, terminal: bool = False) -> None:
        self.file = io.StringIO()
        super().__init__(Console(file=self.file, width=120, force_terminal=terminal))


def test_plan_is_shown_with_counts_and_estimate(store: ArtifactStore, tmp_path: Path) -> None:
    screen = Screen()
    screen.show_plan(fan(tmp_path), store, 2)
    lines = [line.split() for line in screen.file.getvalue().splitlines()]
    assert ["data", "2", "0", "2", "2", "2", "s"] in lines
    assert ["train", "4", "0", "4", "2", "4", "s"] in lines
    assert "7 of 7 nodes to do, about 6 s with 2 at once (a rough guess)." in screen.file.getvalue()
    assert not store.root.exists()  # a dry run leaves no trace


def run_state_of(plan: Plan, store: ArtifactStore) -> tuple[RunState, list[Group]]:
    groups = groups_of(plan, store)
    return RunState(plan, groups, store, 2, ()), groups


def test_run_state_counts_running_fractions_and_failures(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "mlruns")
    plan = fan(tmp_path)
    run_state, groups = run_state_of(plan, store)
    for group in groups[:2]:
        run_state.submitted(group.name)
    write_json(store.progress_file(groups[0].name), {"fraction": 0.5})
    data, train, collect = run_state.components()
    assert (data.done, data.total, data.running) == (0, 2, 1)
    assert data.fraction == 0.25
    assert data.remaining is not None
    # The other source is queued and takes its second; then two seconds of training.
    assert train.remaining == pytest.approx(3.0, abs=0.2)  # time passes while we look
    assert collect.remaining == pytest.approx(6.0, abs=0.2)

    run_state.ended(groups[1].name, GroupResult(groups[1].name, failed={groups[1].keys[0]: "why"}))
    for lane in list(groups[3].nodes):
        groups[3].nodes.remove(lane)
        run_state.skipped(lane.key)
    data, train, _ = run_state.components()
    assert (data.failed, train.skipped, train.over) == (1, 2, False)


@pytest.mark.parametrize("terminal", [False, True])
def test_lines_are_shown_once_or_kept_in_place(tmp_path: Path, terminal: bool) -> None:
    store = ArtifactStore(tmp_path / "mlruns")
    run_state, groups = run_state_of(fan(tmp_path), store)
    screen = Screen(terminal=terminal)
    screen.start(run_state)
    made = store.work / "made"
    made.mkdir()
    source: Node = groups[0].nodes[0]
    seal(made, record_of(source.key, component="data"))
    store.publish(made, source.key)
    run_state.submitted(groups[0].name)
    run_state.ended(groups[0].name, GroupResult(groups[0].name, finished=[source.key]))
    screen.update(run_state)
    screen.update(run_state)
    screen.note("a [bracket] stays")
    screen.stop(run_state)
    text = screen.file.getvalue()
    assert "a [bracket] stays" in text
    assert "1/2" in text
    if not terminal:
        assert text.count("data: 1/2") == 1
        assert "train" in text


def test_durations_read_well() -> None:
    assert [duration(s) for s in (0.4, 59, 61, 3599.7, 9000, 2e5, 79 * 86400, 1e10)] == [
        "0 s",
        "59 s",
        "1 min 01 s",
        "1 h 00 min",
        "2 h 30 min",
        "55 h 33 min",
        "79 days",
        "115,741 days",
    ]


def test_running_work_is_logged_once_a_minute_without_a_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = [1000.0]
    monkeypatch.setattr("flows.pipeline.progress.time.monotonic", lambda: clock[0])
    screen = Screen()
    state = ComponentState(
        component="policy_training",
        total=4,
        reused=0,
        finished=0,
        failed=0,
        skipped=0,
        running=4,
        fraction=0.25,
        per_minute=None,
        remaining=90.0,
    )
    for second in range(150):
        clock[0] = 1000.0 + second
        screen._log(state)
    assert (
        screen.file.getvalue().splitlines()
        == ["policy training: 0/4 25% (4 running), 1 min 30 s left"] * 3
    )  # at 0, 60 and 120 seconds


@pytest.mark.parametrize("terminal", [True, False])
def test_a_plan_is_readable_without_columns(
    terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    assert Display(Console(file=io.StringIO(), force_terminal=terminal)).console.width == 80
    monkeypatch.setenv("COLUMNS", "40")
    console = Display(Console(file=io.StringIO(), force_terminal=terminal)).console
    assert console.width == (40 if terminal else 80)
