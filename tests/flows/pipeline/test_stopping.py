"""Clean stops: limits on the clock, and runs that end at a checkpoint."""

from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import pytest

from components.core.files import read_json, write_json
from flows.pipeline.driver import Driver, DriverRecord, ask_to_stop, driving, is_alive, read_driver
from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.group import GroupCall
from flows.pipeline.limits import Limit
from flows.pipeline.outcome import STOPPED, Outcome
from flows.pipeline.plan import Plan
from flows.pipeline.runner import run_plan
from flows.pipeline.schedule import Group
from flows.pipeline.stopping import PATIENCE, Stop
from flows.pipeline.store import ArtifactStore
from flows.pipeline.task import TaskContext
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.test_runner import Screen, run, value
from tests.flows.pipeline.toys import counted, node

EVENING = datetime(2026, 11, 29, 22, 30)


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds

    def now(self) -> datetime:
        return EVENING + timedelta(seconds=self.seconds)


def test_hours_end_by_a_clock_that_nobody_sets() -> None:
    clock = Clock()
    limit = Limit(hours=8, now=lambda: EVENING + timedelta(days=9), clock=clock)
    assert str(limit) == "after 8 hours"
    clock.seconds = 8 * 3600 - 1
    assert limit.reached() == ""
    clock.seconds += 1
    assert limit.reached() == "max_hours=8 are over"


@pytest.mark.parametrize(
    ("until", "hours", "said"),
    [("07:00", 8.5, "at 07:00 on 2026-11-30"), ("23:00", 0.5, "at 23:00 on 2026-11-29")],
)
def test_a_time_of_day_is_the_next_one(until: str, hours: float, said: str) -> None:
    clock = Clock()
    limit = Limit(until=until, now=clock.now, clock=clock)
    assert str(limit) == said
    clock.seconds = hours * 3600 - 1
    assert limit.reached() == ""
    clock.seconds += 1
    assert limit.reached() == f"it is {until}"


def test_without_a_limit_nothing_is_reached() -> None:
    assert (str(Limit()), Limit().reached()) == ("", "")


def driver_of(store: ArtifactStore, limit: Callable[[], str]) -> Driver:
    record = DriverRecord("toys", "id", "make it so", "here", 1, 0.0, 0.0)
    return Driver(store.root, record, limit)


def test_a_run_stops_at_a_checkpoint_and_goes_on_from_there(
    store: ArtifactStore, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every step is reported, where otherwise half a second passes between two reports.
    monkeypatch.setattr("flows.pipeline.worker.TaskContext", partial(TaskContext, interval=0.0))
    lanes = [node("steps", f"s{i}", log, lanes="s", number=i + 1, steps=20) for i in range(2)]
    last = node("total", "t", log, {f"i{i}": lane for i, lane in enumerate(lanes)})
    screen = Screen()
    limit = driver_of(store, lambda: "it is late" if counted(log, "step-s0") >= 5 else "")
    outcome = run([last], store, screen, driver=limit)
    assert (outcome.exit_code, outcome.status) == (STOPPED, "KILLED")
    assert (outcome.finished, outcome.failed, outcome.skipped) == ([], {}, {})
    assert outcome.may_take_time
    assert counted(log, "step-s0") == 5
    assert "Stopping, since it is late" in screen.text
    assert "Stopped, since it is late; nothing finished is lost. Continue with: make" in screen.text
    assert list((store.root / "progress").iterdir()) == []
    assert len(store.work_folders()) == 1

    assert run([last], store).exit_code == 0
    assert value(store, last) == 20 * (1 + 2)
    assert counted(log, "step-s0") == 20, "no step was made twice"


def test_what_has_no_checkpoint_ends_as_it_is_and_nothing_new_begins(
    store: ArtifactStore, log: Path
) -> None:
    first = node("number", "first", log, number=1, cost=9.0)
    others = [node("number", f"n{i}", log, number=1) for i in range(3)]
    late = driver_of(store, lambda: "late" if counted(log, "finished-first") else "")
    outcome = run([first, *others], store, driver=late)
    assert outcome.finished == [first.key]
    assert outcome.exit_code == STOPPED
    assert run([first, *others], store).exit_code == 0


def test_a_stop_that_finds_everything_done_is_none(store: ArtifactStore, log: Path) -> None:
    late = driver_of(store, lambda: "late" if counted(log, "finished-n") else "")
    outcome = run([node("number", "n", log, number=1)], store, driver=late)
    assert (outcome.exit_code, outcome.stopped) == (0, "")


def test_running_groups_have_two_minutes(store: ArtifactStore, log: Path) -> None:
    clock = Clock()
    stop = Stop(store, driver_of(store, lambda: "late"), lambda text: None, clock)
    assert not stop.over
    group = Group("group", [node("number", "n", log, number=1)], set())
    stop.look(Outcome(), {"group": group}, SerialExecutor())
    assert store.pause_file("group").exists()
    clock.seconds = PATIENCE - 1
    assert not stop.over
    clock.seconds = PATIENCE
    assert stop.over
    stop.forget(["group"])
    assert not store.pause_file("group").exists()


class Shared(SerialExecutor):
    """Another driver, which stops, computes the first group that this one takes, too."""

    def submit(self, call: GroupCall) -> None:
        super().submit(call)
        self.asked = [*getattr(self, "asked", []), call.group]
        if len(self.asked) == 1:
            ArtifactStore(call.root, create=False).pause_file(call.group).touch()


def test_a_pause_that_another_driver_asked_for_ends_no_run(store: ArtifactStore, log: Path) -> None:
    made = node("number", "n", log, number=1)
    executor = Shared()
    outcome = run_plan(Plan([made]), store, NullTracker(), Screen(), executor=executor)
    assert (outcome.exit_code, outcome.finished) == (0, [made.key])
    assert len(executor.asked) == 2


def test_a_driver_is_known_by_its_lock_here_and_by_its_beat_elsewhere(
    store: ArtifactStore,
) -> None:
    assert read_driver(store.root, "toys") is None
    with driving(store, "toys", "make it so") as driver:
        told = read_driver(store.root, "toys")
        assert told is not None
        assert is_alive(store.root, told, now=told.beat + 1e9), "whatever the clock says"
        assert ask_to_stop(store.root, told, told.beat)
        assert driver.reason_to_stop() == "flows.stop asked for it"
        with (
            pytest.raises(PipelineError, match="Another process is running the sweep 'toys'"),
            driving(store, "toys", "make it so"),
        ):
            pass
    assert not is_alive(store.root, told, told.beat), "its lock is free"
    assert not ask_to_stop(store.root, told, told.beat)
    assert list((store.root / "drivers").iterdir()) == [store.root / "drivers" / "toys.json"]
    ended = read_driver(store.root, "toys")
    assert ended is not None
    assert ended.ended == "FAILED", "nobody said that it was well"

    elsewhere = DriverRecord("toys", "id", "make it so", "another-computer", 1, 0.0, 100.0)
    (store.locks / "driver-toys.lock").unlink(missing_ok=True)
    assert is_alive(store.root, elsewhere, now=150.0)
    assert not is_alive(store.root, elsewhere, now=500.0)


def test_a_request_reaches_only_the_driver_it_was_meant_for(store: ArtifactStore) -> None:
    driver = driver_of(store, lambda: "")
    driver.write()
    (store.root / "drivers" / "toys.stop").write_text("another one", encoding="utf-8")
    assert driver.reason_to_stop() == ""


def test_a_damaged_record_of_a_driver_is_none(store: ArtifactStore) -> None:
    (store.root / "drivers").mkdir()
    for content in ([], {"name": "toys"}, {"unknown": 1}):
        write_json(store.root / "drivers" / "toys.json", content)
        assert read_driver(store.root, "toys") is None
    assert read_json(store.root / "drivers" / "toys.json") == {"unknown": 1}
