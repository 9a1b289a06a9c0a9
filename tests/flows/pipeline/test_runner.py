"""The serial runner: results, reuse, failures that stay alone, continuation from checkpoints."""

import io
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from components.core.files import read_json, write_json
from components.core.sealed import seal
from flows.pipeline import runner
from flows.pipeline.audit import audit
from flows.pipeline.driver import Driver
from flows.pipeline.errors import TrackingError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.group import GroupCall
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.run_state import RunState
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.schedule import form_groups
from flows.pipeline.signals import ending_signals
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import TaskContext
from flows.pipeline.tracking.tracker import NullTracker, Tracker
from tests.flows.pipeline.toys import counted, diamond, node, record_of


class Screen(Display):
    """A display whose text can be read."""

    def __init__(self) -> None:
        super().__init__(Console(file=io.StringIO(), width=200))

    @property
    def text(self) -> str:
        return self.console.file.getvalue()  # type: ignore[attr-defined]


def run(
    nodes: list[Node],
    store: ArtifactStore,
    screen: Display | None = None,
    tracker: Tracker | None = None,
    *,
    repairs: bool = True,
    driver: Driver | None = None,
) -> Outcome:
    return run_plan(
        Plan(nodes),
        store,
        tracker or NullTracker(),
        screen or Screen(),
        executor=SerialExecutor(),
        command="make it so",
        repairs=repairs,
        driver=driver,
    )


def value(store: ArtifactStore, wanted: Node) -> float:
    return read_json(store.path(wanted.key) / "value.json")


def fast_diamond(log: Path) -> Node:
    return diamond(log, pause=0.0)[0]


def test_plan_is_computed_then_reused(store: ArtifactStore, log: Path) -> None:
    last = fast_diamond(log)
    first = run([last], store)
    assert (first.status, first.exit_code, len(first.finished)) == ("FINISHED", 0, 9)
    # Two groups of lanes with numbers 1, 2, 3, each added up over 20 steps.
    assert value(store, last) == 2 * 20 * (1 + 2 + 3)
    assert list(store.work.iterdir()) == []
    assert list((store.root / "progress").iterdir()) == []

    screen = Screen()
    second = run([last], store, screen)
    assert second.finished == []
    assert len(second.reused) == 9
    assert counted(log, "finished-sum") == 1
    assert "train: 6/6 (6 reused), done" in screen.text


def test_another_sweep_reuses_what_it_shares(store: ArtifactStore, log: Path) -> None:
    shared = node("number", "shared", log, number=2)
    run([node("total", "one", log, {"a": shared})], store)
    run([node("total", "two", log, {"a": shared, "b": shared})], store)
    assert counted(log, "finished-shared") == 1
    assert counted(log, "finished-two") == 1


def test_node_json_says_what_the_artifact_is(store: ArtifactStore, log: Path) -> None:
    source = node("number", "n", log, number=2)
    last = node("total", "t", log, {"a": source})
    run([last], store)
    record = store.record(last.key)
    assert record["inputs"] == {"a": source.key}
    assert record["config"] == dict(last.config)
    assert record["component"] == "toys"
    assert record["finished"] >= record["started"]
    assert record["wall_seconds"] >= 0
    assert record["peak_rss_mib"] > 1
    assert "Python" in record["hardware"]
    assert record["software"]["numpy"] == np.__version__
    assert record["software"]["device"] in record["hardware"]
    assert record["tags"]["colour"] == "blue", "of the task, beside those of the node"


def test_failure_stops_only_what_needs_it(store: ArtifactStore, log: Path) -> None:
    bad = node("fails", "bad", log, number=1)
    good = node("number", "good", log, number=2)
    needs = node("total", "needs", log, {"a": bad, "b": good})
    far = node("total", "far", log, {"a": needs})
    other = node("total", "other", log, {"a": good})
    screen = Screen()
    outcome = run([far, other], store, screen)
    assert list(outcome.failed) == [bad.key]
    assert "this toy fails on purpose" in outcome.failed[bad.key]
    assert "Traceback" in outcome.failed[bad.key]
    assert outcome.skipped == {needs.key: bad.key, far.key: bad.key}
    assert set(outcome.finished) == {good.key, other.key}
    assert (outcome.status, outcome.exit_code) == ("FAILED", 1)
    assert "toys bad failed: ValueError: this toy fails on purpose" in screen.text
    assert "2/5 (1 failed, 2 skipped)" in screen.text

    (log / "repaired").touch()
    again = run([far, other], store)
    assert again.exit_code == 0
    assert set(again.finished) == {bad.key, needs.key, far.key}
    assert value(store, far) == 3.0
    assert counted(log, "finished-good") == 1


def test_lanes_run_without_the_one_whose_input_failed(store: ArtifactStore, log: Path) -> None:
    sources = [node("fails_in_part", f"n{i}", log, number=i, lanes="n") for i in (-1, 1, 2)]
    lanes = [node("total", f"t{i}", log, {"a": s}, lanes="t") for i, s in enumerate(sources)]
    outcome = run(lanes, store)
    assert outcome.failed == {sources[0].key: "the number is negative"}
    assert list(outcome.skipped) == [lanes[0].key]
    assert [value(store, lane) for lane in lanes[1:]] == [1.0, 2.0]


def half_done(log: Path) -> list[Node]:
    return [
        node("steps", f"s{i}", log, lanes="s", number=i + 1, steps=8, hold=5, patience=0.0)
        for i in range(3)
    ]


def test_group_continues_from_its_checkpoint(store: ArtifactStore, log: Path) -> None:
    lanes = half_done(log)
    assert set(run(lanes, store).failed) == {lane.key for lane in lanes}
    assert counted(log, "step-s0") == 5
    (log / "go").touch()
    assert run(lanes, store).exit_code == 0
    assert [value(store, lane) for lane in lanes] == [8.0, 16.0, 24.0]
    assert counted(log, "step-s0") == 8
    assert store.record(lanes[0].key)["resumed"]


def test_partly_published_group_continues_from_its_checkpoint(
    store: ArtifactStore, log: Path
) -> None:
    lanes = half_done(log)
    run(lanes, store)
    made = store.work / "by-somebody-else"
    made.mkdir()
    seal(made, record_of(lanes[1].key))
    store.publish(made, lanes[1].key)
    (log / "go").touch()
    outcome = run(lanes, store)
    assert outcome.reused == [lanes[1].key]
    assert [value(store, lanes[i]) for i in (0, 2)] == [8.0, 24.0]
    assert counted(log, "step-s0") == 8
    assert counted(log, "step-s1") == 5
    assert list(store.work.iterdir()) == []


def test_fewer_then_more_lanes_share_one_checkpoint(store: ArtifactStore, log: Path) -> None:
    lanes = half_done(log)
    run(lanes[:2], store)
    (log / "go").touch()
    assert run(lanes[:1], store).exit_code == 0
    assert run(lanes, store).exit_code == 0
    assert [value(store, lane) for lane in lanes] == [8.0, 16.0, 24.0]
    assert [counted(log, f"step-s{i}") for i in range(3)] == [8, 8, 8]
    store.repair()
    assert list(store.work.iterdir()) == []


def test_task_that_writes_nothing_or_is_missing_fails_clearly(
    store: ArtifactStore, log: Path
) -> None:
    empty = node("count_nothing", "missing", log)
    nothing = replace(empty, name="nothing", task="tests.flows.pipeline.toys:nothing")
    outcome = run([empty, nothing], store)
    assert "no task function 'count_nothing'" in outcome.failed[empty.key]
    assert "wrote nothing for nothing" in outcome.failed[nothing.key]


class BrokenTracker(NullTracker):
    """Refuses until it is mended."""

    def __init__(self) -> None:
        self.broken = True
        self.known: list[str] = []
        self.asked = 0

    def log_node(self, node: Node, folder: Path) -> None:
        self.asked += 1
        if self.broken:
            raise TrackingError("MLflow is away: mend it.")
        self.known.append(node.name)


def test_tracker_that_refuses_costs_no_work(store: ArtifactStore, log: Path) -> None:
    nodes = [node("number", f"n{i}", log, number=i) for i in range(5)]
    tracker = BrokenTracker()
    screen = Screen()
    outcome = run(nodes, store, screen, tracker)
    assert len(outcome.finished) == 5
    assert outcome.unrecorded == "MLflow is away: mend it."
    assert (outcome.status, outcome.exit_code) == ("FINISHED", 1)
    assert screen.text.count("MLflow is away") == 1
    assert tracker.asked < 5  # a server that does not answer is not asked for every node

    tracker.broken = False
    outcome = run(nodes, store, None, tracker)
    assert outcome.exit_code == 0
    assert sorted(tracker.known) == ["n0", "n1", "n2", "n3", "n4"]


def test_interrupt_keeps_what_is_finished(store: ArtifactStore, log: Path) -> None:
    first = node("number", "first", log, number=1, cost=9.0)
    second = node("interrupted", "second", log, number=1)
    screen = Screen()
    outcome = run([first, second], store, screen)
    assert outcome.interrupted
    assert (outcome.status, outcome.exit_code) == ("KILLED", 130)
    assert outcome.finished == [first.key]
    assert "Continue with: make it so" in screen.text


def test_longest_chain_starts_first(store: ArtifactStore, log: Path) -> None:
    short = [node("number", f"short{i}", log, number=i, cost=2.0) for i in range(2)]
    head = node("number", "head", log, number=1, cost=0.5)
    tail = node("total", "tail", log, {"a": head}, cost=5.0)
    outcome = run([*short, tail], store)
    order = [Plan([*short, tail])[key].name for key in outcome.finished]
    assert order.index("head") == 0
    assert order.index("tail") < max(order.index("short0"), order.index("short1"))


class Looking(SerialExecutor):
    """Notes what is on record about a group when it is submitted."""

    def __init__(self, store: ArtifactStore) -> None:
        super().__init__()
        self.store = store
        self.seen: list[tuple[float | None, bool]] = []

    def submit(self, call: GroupCall) -> None:
        found = self.store.fraction(call.group), self.store.stop_file(call.group).exists()
        self.seen.append(found)
        super().submit(call)


def test_what_a_killed_call_has_reported_is_forgotten(store: ArtifactStore, log: Path) -> None:
    plan = Plan([node("number", "n", log, number=1)])
    [group] = form_groups(plan, [one.key for one in plan], store)
    write_json(store.progress_file(group.name), {"fraction": 0.9, "losses": [[0.9, 1.0]]})
    store.stop_file(group.name).touch()
    looking = Looking(store)
    run_plan(plan, store, NullTracker(), Screen(), executor=looking)
    assert looking.seen == [(None, False)]


def test_begun_nodes_are_shown_with_what_their_checkpoint_holds(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every step is reported, where otherwise half a second passes between two reports.
    monkeypatch.setattr("flows.pipeline.worker.TaskContext", partial(TaskContext, interval=0.0))
    lanes = half_done(log)
    last = node("total", "t", log, {f"i{i}": lane for i, lane in enumerate(lanes)}, cost=3.0)
    run(lanes, store)
    # Five steps of eight are saved; a step is reported after it is, so the note is one behind.
    assert store.begun() == {frozenset(lane.key for lane in lanes): 4 / 8}

    screen = Screen()
    screen.show_plan(Plan([last]), ArtifactStore(store.root, create=False), 1)
    # 4.5 s of work, and what the driver itself has to do with four nodes.
    assert "4 of 4 nodes to do, 3 of them begun (50%), about 5 s" in screen.text
    assert "3, 50%" in screen.text

    plan = Plan([last])
    groups = form_groups(plan, [one.key for one in plan], store)
    run_state = RunState(plan, groups, store, 1, ())
    state, *_ = run_state.components()
    assert (state.begun, state.running, state.fraction) == (3, 0, 0.25)
    assert state.remaining == pytest.approx(4.5, abs=0.2)

    # The worker starts from there, so that nothing looks like fast progress.
    work = store.open_work([lane.key for lane in lanes])
    context = TaskContext(work.path, progress_file=store.progress_file("g"))
    context.begin()
    assert store.fraction("g") == 0.5

    (log / "go").touch()
    assert run([last], store).exit_code == 0
    assert store.begun() == {}


def test_half_written_checkpoint_is_none(store: ArtifactStore) -> None:
    work = store.open_work(["a" * 32])
    (work.path / ".checkpoint.json-0123456789ab.json").touch()
    [found] = store.work_folders()
    assert not found.resumed


def test_a_clock_that_is_set_back_changes_no_duration(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(10**9, 0, -(10**6)))
    monkeypatch.setattr("flows.pipeline.worker.time.time", lambda: float(next(clock)))
    made = node("number", "n", log, number=1)
    run([made], store)
    record = store.record(made.key)
    assert record["finished"] < record["started"]
    assert 0.0 <= record["wall_seconds"] < 1000.0
    assert 0.0 <= record["seconds"] < 1000.0


def test_sigterm_ends_a_run_as_an_interrupt_does(store: ArtifactStore, log: Path) -> None:
    first = node("number", "first", log, number=1, cost=9.0)
    second = node("terminated", "second", log, number=1)
    screen = Screen()
    with ending_signals():
        outcome = run([first, second], store, screen)
    assert (outcome.status, outcome.exit_code) == ("KILLED", 143)
    assert not outcome.may_take_time
    assert outcome.finished == [first.key]
    assert "Continue with: make it so" in screen.text


@pytest.mark.parametrize("meanwhile", ["nothing", "gone", "come", "replaced"])
def test_a_store_is_looked_at_again_only_if_its_artifacts_are_others(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    last = fast_diamond(log)
    plan = Plan([last])
    run([last], store)
    folder = store.path(last.key)
    if meanwhile == "come":
        folder.rename(store.root / "aside")
    found = audit(plan, store)
    if meanwhile == "come":
        (store.root / "aside").rename(folder)
    elif meanwhile == "gone":
        shutil.rmtree(folder)
    elif meanwhile == "replaced":  # by one that is damaged
        shutil.copytree(folder, store.root / "copy")
        (store.root / "copy" / "value.json").unlink()
        folder.rename(store.root / "aside")
        (store.root / "copy").rename(folder)
    looked = []
    monkeypatch.setattr(runner, "audit", lambda *given: looked.append(1) or audit(*given))
    outcome = run_plan(plan, store, NullTracker(), Screen(), executor=SerialExecutor(), found=found)
    assert bool(looked) == (meanwhile != "nothing")
    assert (outcome.status, len(outcome.reused) + len(outcome.finished)) == ("FINISHED", 9)
    assert outcome.finished == ([last.key] if meanwhile in ("gone", "replaced") else [])
    assert value(store, last) == 2 * 20 * (1 + 2 + 3)
