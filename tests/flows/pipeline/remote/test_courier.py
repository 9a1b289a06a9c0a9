"""What drivers carry to and fro: their own record and requests, and nobody else's."""

import json
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from components.core.files import write_json
from flows.pipeline.driver import Driver, DriverRecord, ask_to_stop, driving, read_driver
from flows.pipeline.errors import PipelineError
from flows.pipeline.group import GroupCall
from flows.pipeline.remote.bringing import Glance, bring
from flows.pipeline.remote.courier import DriverCourier
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.places import CACHE, copy_of
from flows.pipeline.remote.shared_store import SharedStore, store_at
from flows.pipeline.sweep_records import SweepRecord
from tests.flows.pipeline.toys import node


@pytest.fixture
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    return f"file://{tmp_path}/shared"


@pytest.fixture
def objects(url: str) -> Objects:
    return Objects(url)


def courier(store: SharedStore, name: str) -> DriverCourier:
    """A driver's courier that looks when it is told to; the sweep is its own."""
    made = DriverCourier(store.objects, store, name, store._claims, store._groups)
    made.begin()
    return made


def driver(url: str) -> SharedStore:
    store = store_at(copy_of(url), drives=True)
    assert isinstance(store, SharedStore)
    return store


def record(name: str, id: str, **values: object) -> DriverRecord:
    now = time.time()
    return DriverRecord(name, id, "it", "a-host", 1, now, now, **values)  # type: ignore[arg-type]


def told(store: SharedStore, name: str, id: str) -> None:
    """What a driver has written into this machine's copy."""
    Driver(store.root, record(name, id)).write()


def test_a_driver_takes_its_own_requests_and_leaves_those_of_others(
    url: str, objects: Objects
) -> None:
    store = driver(url)
    ours = courier(store, "ours")
    told(store, "ours", "our-id")
    objects.write("drivers/other.stop", b"other-id")
    objects.write("drivers/ours.stop", b"our-id")
    ours.look()
    assert objects.read("drivers/other.stop") == b"other-id"
    assert objects.read("drivers/ours.stop") is None
    assert (store.root / "drivers" / "ours.stop").read_text() == "our-id"
    assert not (store.root / "drivers" / "other.stop").exists()
    objects.write("drivers/ours.stop", b"an-id-of-another-driver")
    ours.look()
    assert objects.read("drivers/ours.stop") == b"an-id-of-another-driver"
    courier(store, "ours")  # whoever has the sweep next forgets what nobody else can take
    assert objects.read("drivers/ours.stop") is None


def test_who_waits_for_a_sweep_carries_nothing(url: str, objects: Objects) -> None:
    holder = SharedStore(url, "holder", drives=True)
    holder._claims.beat()
    holder._claims.take(["sweep-ours"])
    objects.write("drivers/ours.json", b"of the holder")
    objects.write("drivers/ours.stop", b"to the holder")
    store = driver(url)
    told(store, "ours", "of an earlier run here")
    looked = []

    def look_and_beat(seconds: float) -> None:
        made = DriverCourier(objects, store, "ours", store._claims, store._groups)
        made.look()
        looked.append(made)
        holder._claims.beat()

    store._claims._pause = look_and_beat
    with pytest.raises(PipelineError, match="Another process is running"), store.driven("ours"):
        pass
    assert looked
    assert objects.read("drivers/ours.json") == b"of the holder"
    assert objects.read("drivers/ours.stop") == b"to the holder"


def test_a_driver_sends_its_own_record_and_only_what_it_has_written_itself(
    url: str, objects: Objects
) -> None:
    store = driver(url)
    told(store, "ours", "of an earlier run here")
    told(store, "other", "brought once")
    SweepRecord("other", "it", {}).save(store.root)
    objects.write("drivers/other.json", b"newer")
    ours = courier(store, "ours")
    ours.look()
    assert objects.read("drivers/ours.json") is None
    told(store, "ours", "our-id")
    SweepRecord("ours", "it", {}).save(store.root)
    ours.look()
    assert json.loads(objects.read("drivers/ours.json") or b"")["id"] == "our-id"
    assert objects.read("drivers/other.json") == b"newer"
    assert sorted(objects.sizes("sweeps")) == ["sweeps/ours.json"]


def test_a_driver_whose_sweep_another_one_has_taken_over_is_silent(
    url: str, objects: Objects
) -> None:
    store = driver(url)
    ours = courier(store, "ours")
    successor = SharedStore(url, "successor", drives=True)
    successor._claims.beat()
    objects.write("locks/sweep-ours.claim", b"successor")
    told(store, "ours", "our-id")
    objects.write("drivers/ours.stop", b"our-id")
    ours.look()
    assert objects.read("drivers/ours.json") is None
    assert objects.read("drivers/ours.stop") == b"our-id"
    successor._claims.end()
    ours.look()  # and goes on when nobody has it any more
    assert objects.read("drivers/ours.json") is not None
    assert objects.read("drivers/ours.stop") is None


def test_a_driver_asks_and_hears_its_own_calls_only(
    url: str, objects: Objects, tmp_path: Path
) -> None:
    store = driver(url)
    ours = courier(store, "ours")
    store.sent(GroupCall.of("our-call", store.root, [node("number", "n", tmp_path, number=1)]))
    for call in ("our-call", "another"):
        store.pause_file(call).touch()  # the other one by a worker of another driver on this disk
        objects.write(f"progress/{call}.json", json.dumps({"at": 1.0, "fraction": 0.5}).encode())
    ours.look()
    assert objects.read("progress/our-call.pause") == b""
    assert objects.read("progress/another.pause") is None
    assert (store.fraction("our-call"), store.fraction("another")) == (0.5, None)
    store.clear_progress("our-call")
    store.pause_file("our-call").touch()
    ours.look()
    assert sorted(objects.sizes("progress")) == ["progress/another.json"]


def test_nothing_is_left_of_calls_that_have_not_come_back(
    url: str, objects: Objects, tmp_path: Path
) -> None:
    store = driver(url)
    with store.driven("ours"):
        store.sent(GroupCall.of("call", store.root, [node("number", "n", tmp_path, number=1)]))
        objects.write("progress/call.json", b"{}")
        objects.write("progress/call.pause", b"")
    assert objects.sizes("progress") == {}


def test_the_last_record_is_the_last_one_sent(
    url: str, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look that is under way when the end comes must not send an older one after it."""
    begun: list[DriverCourier] = []
    enter, sending = DriverCourier.__enter__, threading.Event()
    monkeypatch.setattr(DriverCourier, "__enter__", lambda self: begun.append(self) or enter(self))
    monkeypatch.setattr("flows.pipeline.remote.courier.BETWEEN", 0.01)
    store = driver(url)
    write = store.objects.write

    def slowly(name: str, content: bytes) -> None:
        if name == "drivers/ours.json" and not json.loads(content)["ended"]:
            sending.set()
            assert begun[0]._over.wait(60)
        write(name, content)

    monkeypatch.setattr(store.objects, "write", slowly)
    with store.driven("ours"), driving(store, "ours", "it"):
        assert sending.wait(60)
    assert json.loads(objects.read("drivers/ours.json") or b"")["ended"] == "FAILED"


def test_who_asks_one_driver_sends_no_request_to_another(url: str, objects: Objects) -> None:
    for name in ("one", "two"):
        content = json.dumps(asdict(record(name, f"id-{name}"))).encode()
        objects.write(f"drivers/{name}.json", content)
    objects.write("drivers/two.stop", b"id-two")
    looking = Glance(url, copy_of(url))
    looking.look_again()
    objects.delete(["drivers/two.stop"])  # its driver has taken it meanwhile
    one = read_driver(looking.root, "one")
    assert one is not None
    assert ask_to_stop(looking.root, one, time.time())
    looking.send_request("one")
    assert objects.read("drivers/one.stop") == b"id-one"
    assert objects.read("drivers/two.stop") is None
    looking.send_request("two")  # that nobody has made
    assert objects.read("drivers/two.stop") is None


def test_who_looks_leaves_what_a_driver_here_has_written(url: str, objects: Objects) -> None:
    store = driver(url)
    for name in ("here", "far"):
        objects.write(f"drivers/{name}.json", json.dumps(asdict(record(name, "old"))).encode())
        objects.write(f"progress/of-{name}.json", b'{"at": 1.0, "fraction": 0.1}')
        content = {"format_version": 1, "name": name, "command": "old", "nodes": {}}
        objects.write(f"sweeps/{name}.json", json.dumps(content).encode())
    with driving(store, "here", "it"):
        SweepRecord("here", "new", {}).save(store.root)
        write_json(store.progress_file("of-here"), {"at": 2.0, "fraction": 0.2})
        ours = read_driver(store.root, "here")
        bring(store.root)
        assert read_driver(store.root, "here") == ours
        assert json.loads((store.root / "sweeps" / "here.json").read_text())["command"] == "new"
        assert store.fraction("of-here") == 0.2
        far = read_driver(store.root, "far")
        assert far is not None
        assert far.id == "old"
    bring(store.root)
    assert read_driver(store.root, "here") != ours
    assert store.fraction("of-far") == 0.1


def test_only_the_tracking_of_its_own_sweep_is_sent(url: str, objects: Objects) -> None:
    store = driver(url)
    (store.root / "tracking").mkdir()
    for name in ("ours", "other"):
        (store.root / "tracking" / f"{name}.jsonl").write_text("{}\n", encoding="utf-8")
    objects.write("tracking/other.jsonl", b"newer")
    with store.driven("ours"):
        pass
    assert objects.read("tracking/other.jsonl") == b"newer"
    assert objects.read("tracking/ours.jsonl") == b"{}\n"
