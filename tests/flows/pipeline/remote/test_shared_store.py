"""A shared store: the contract of the local one, and what only machines apart can see."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from components.core.files import read_json, write_json
from components.core.integrity import DamagedFileError
from components.core.sealed import seal
from flows.pipeline.audit import audit
from flows.pipeline.errors import PipelineError, StoreError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.group import GroupCall
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.remote.bringing import glance
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.places import CACHE, address_of, copy_of
from flows.pipeline.remote.shared_store import SharedStore, store_at
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.pipeline.tracking.tracker import NullTracker
from flows.pipeline.worker import run_group
from tests.flows.pipeline.toys import counted, diamond, node, record_of

A, B, C = (letter * 32 for letter in "abc")


class Elsewhere:
    """Machines, each with its own folder of copies."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder, self._monkeypatch = tmp_path, monkeypatch

    def __call__(self, name: str) -> None:
        self._monkeypatch.setenv(CACHE, str(self._folder / name))


@pytest.fixture
def on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Elsewhere:
    """Goes to another machine."""
    return Elsewhere(tmp_path, monkeypatch)


@pytest.fixture(params=["local", "file", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ArtifactStore:
    """A store of every kind, as a worker has it."""
    if request.param == "local":
        return ArtifactStore(tmp_path / "mlruns")
    request.getfixturevalue("cache")
    if request.param == "file":
        return SharedStore(f"file://{tmp_path}/shared", "us")
    from tests.flows.pipeline.remote.conftest import bucket

    environment = request.getfixturevalue("s3")
    return SharedStore(bucket(environment, request.getfixturevalue("monkeypatch")), "us")


def make(store: ArtifactStore, key: str, text: str = "content") -> None:
    folder = store.work / f"made-{key}"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "file").write_text(text, encoding="utf-8")
    seal(folder, record_of(key))
    store.publish(folder, key)


# The contract, of all stores alike


def test_the_first_publisher_wins_and_nothing_is_left(store: ArtifactStore) -> None:
    make(store, A, "first")
    make(store, A, "second")
    assert store.intact(A, large=True)
    assert (store.path(A) / "deep" / "file").read_text() == "first"
    assert list(store.work.iterdir()) == []


def test_what_is_there_stays_when_it_is_fetched(store: ArtifactStore) -> None:
    make(store, A)
    place = store.place(A)
    store.fetch([A, B])
    assert (store.place(A), store.complete(B)) == (place, False)


def test_work_is_found_again_by_what_it_has_to_do(store: ArtifactStore) -> None:
    with store.locked([A, B]):
        store.begin([A, B])
        work = store.open_work([A, B])
        write_json(work.path / "checkpoint.json", {"step": 3})
        with store.carrying("group", work):
            pass
    with store.locked([A, B]):
        store.begin([A, B])
        again = store.open_work([A, B])
    assert (again.path, again.resumed) == (work.path, True)
    assert read_json(again.path / "checkpoint.json") == {"step": 3}


def test_damage_is_set_aside_once(store: ArtifactStore) -> None:
    make(store, A)
    (store.path(A) / "deep" / "file").write_text("CONTENT", encoding="utf-8")
    assert not store.intact(A)
    with store.locked([A], wait=False) as held:
        assert held
        assert store.set_aside(A, store.place(A))
    assert not store.path(A).exists()
    assert (store.damaged / A / "deep" / "file").exists()


def run(store: ArtifactStore, plan: Plan) -> Outcome:
    with store.driven("sweep"):
        return run_plan(plan, store, NullTracker(), Display(), executor=SerialExecutor())


@pytest.fixture(params=["local", "file", "s3"])
def driver(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], ArtifactStore]:
    """Opens a store of every kind, as a driver does."""
    if request.param == "local":
        return lambda: ArtifactStore(tmp_path / "mlruns")
    request.getfixturevalue("cache")
    if request.param == "file":
        url = f"file://{tmp_path}/shared"
    else:
        from tests.flows.pipeline.remote.conftest import bucket

        environment = request.getfixturevalue("s3")
        url = bucket(environment, request.getfixturevalue("monkeypatch"))
    return lambda: store_at(copy_of(url), drives=True)


def test_a_plan_runs_once_and_is_reused(driver: Callable[[], ArtifactStore], log: Path) -> None:
    plan = Plan(diamond(log, pause=0.0))
    (last,) = diamond(log, pause=0.0)
    store = driver()
    outcome = run(store, plan)
    assert (outcome.exit_code, len(outcome.finished)) == (0, 9)
    assert read_json(store.path(last.key) / "value.json") == 240.0
    again = run(driver(), plan)
    assert (len(again.finished), len(again.reused)) == (0, 9)
    assert all(counted(log, f"finished-{n.name}") == 1 for n in plan)
    assert not store.work_folders()
    assert sorted(path.name for path in store.locks.iterdir()) == []


# Machines apart


def test_an_artifact_is_whole_on_another_machine(url: str, on: Elsewhere) -> None:
    make(SharedStore(url, "us"), A)
    on("elsewhere")
    there = SharedStore(url, "they")
    assert not there.complete(A)
    there.fetch([A, B])
    assert there.check(A)["key"] == A
    assert (there.path(A) / "deep" / "file").read_text() == "content"
    assert list((there.root / "arriving").iterdir()) == []


def test_without_its_record_an_artifact_is_not_there(url: str, on: Elsewhere) -> None:
    make(SharedStore(url, "us"), A)
    Objects(url).delete([f"nodes/{A}/node.json"])  # as a push that was killed before the last file
    on("elsewhere")
    there = SharedStore(url, "they")
    there.fetch([A])
    assert not there.path(A).exists()


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_a_damaged_artifact_is_not_believed_and_made_again(
    damage: str, url: str, on: Elsewhere
) -> None:
    make(SharedStore(url, "us"), A)
    objects = Objects(url)
    if damage == "changed":
        objects.write(f"nodes/{A}/deep/file", b"CONTENT")
    else:
        objects.delete([f"nodes/{A}/deep/file"])
    on("elsewhere")
    there = SharedStore(url, "they")
    there.fetch([A])
    assert not there.path(A).exists()
    assert objects.read(f"nodes/{A}/node.json") is None
    assert objects.read(f"damaged/{A}/node.json") is not None
    make(there, A)
    assert there.intact(A, large=True)


def test_a_damaged_copy_is_brought_again(url: str, cache: Path) -> None:
    store = SharedStore(url, "us")
    make(store, A)
    (store.path(A) / "deep" / "file").write_text("CONTENT", encoding="utf-8")
    store.fetch([A])
    assert store.intact(A, large=True)


def test_a_name_that_leaves_its_folder_is_refused(url: str, on: Elsewhere, tmp_path: Path) -> None:
    make(SharedStore(url, "us"), A)
    objects = Objects(url)
    record = json.loads(objects.read(f"nodes/{A}/node.json") or b"")
    record["files"]["../../../outside"] = record["files"]["deep/file"]
    objects.write(f"nodes/{A}/node.json", json.dumps(record).encode())
    on("elsewhere")
    there = SharedStore(url, "they")
    there.fetch([A])
    assert not there.path(A).exists()
    assert not list(tmp_path.rglob("outside"))


def test_a_checkpoint_is_continued_on_another_machine(url: str, on: Elsewhere) -> None:
    here = SharedStore(url, "us")
    with here.locked([A, B]):
        work = here.open_work([A, B])
        (work.path / "snapshots").mkdir()
        (work.path / "snapshots" / "1").write_text("one", encoding="utf-8")
        write_json(work.path / "checkpoint.json", {"step": 3})
        write_json(work.path / "reached.json", 0.5)
        here.fresh_out(work, [A, B])
        (work.out(A) / "half").write_text("made", encoding="utf-8")
        here.save(work)
    on("elsewhere")
    there = SharedStore(url, "us")  # another worker of the same driver
    assert not there.work_folders()
    there.begin([A, B])
    (found,) = there.work_folders()
    assert (found.members, found.resumed) == ((A, B), True)
    assert read_json(found.path / "checkpoint.json") == {"step": 3}
    assert (found.path / "snapshots" / "1").read_text() == "one"
    assert not (found.path / "out").exists()
    assert list(there.begun().values()) == [0.5]
    write_json(found.path / "reached.json", 0.75)
    write_json(found.path / "checkpoint.json", {"step": 5})
    there.begin([A, B])  # what is further here stays
    assert read_json(found.path / "checkpoint.json") == {"step": 5}
    there.discard(found)
    assert not Objects(url).sizes("work")


def test_a_half_written_checkpoint_leaves_the_former_one(url: str, on: Elsewhere) -> None:
    here = SharedStore(url, "us")
    work = here.open_work([A])
    write_json(work.path / "checkpoint.json", {"step": 3})
    here.save(work)
    objects = Objects(url)
    objects.write(f"work/{work.path.name}/{'0' * 64}", b"of a push that was killed")
    on("elsewhere")
    there = SharedStore(url, "us")
    there.begin([A])
    (found,) = there.work_folders()
    assert read_json(found.path / "checkpoint.json") == {"step": 3}
    write_json(found.path / "checkpoint.json", {"step": 4})
    there.save(found)
    assert len(objects.sizes("work")) == 3  # the list, the members, the checkpoint


def test_a_work_folder_that_goes_while_it_is_pushed_is_not_pushed_in_part(
    url: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SharedStore(url, "us")
    work = store.open_work([A])
    (work.path / "deep").mkdir()
    write_json(work.path / "deep" / "snapshot.json", {})
    link = os.link

    def discarded(source: Path, target: Path) -> None:
        link(source, target)
        store.discard(work)  # by another process, after the first of its files

    monkeypatch.setattr(os, "link", discarded)
    store.save(work)
    store.save(work)  # of which nothing is left
    assert not Objects(url).sizes("work")


def test_who_looks_sees_what_was_made_again_or_taken_away(url: str, on: Elsewhere) -> None:
    here = SharedStore(url, "us")
    make(here, A, "first")
    make(here, B)
    SweepRecord("sweep", "it", {A: "a", B: "b"}).save(here.root)
    here.push_files("sweeps")
    on("elsewhere")
    glance(copy_of(url))
    on("here")
    for key in (A, B):
        Objects(url).delete(Objects(url).sizes(f"nodes/{key}"))
    shutil.rmtree(here.path(A))
    make(here, A, "second")
    on("elsewhere")
    there = glance(copy_of(url))
    assert (there.path(A) / "deep" / "file").read_text() == "second"
    assert not there.path(B).exists()


def test_a_folder_outside_the_store_travels(url: str, on: Elsewhere, tmp_path: Path) -> None:
    outside = tmp_path / "log-of-a-plant"
    outside.mkdir()
    (outside / "card.json").write_text("{}", encoding="utf-8")
    (outside / "twin.json").write_text("{}", encoding="utf-8")
    here = SharedStore(url, "us", drives=True)
    from flows.pipeline.group import GroupCall

    described = node("number", "n", tmp_path, number=1)
    object.__setattr__(described, "folders", {"log": str(outside)})
    call = here.sent(GroupCall.of("g", here.root, [described]))
    assert (call.url, call.owner) == (url, "us")
    named = call.nodes[0]["folders"]["log"]
    shutil.rmtree(outside)
    on("elsewhere")
    there = SharedStore(url, "us")
    found = there.folder(named)
    assert sorted(path.name for path in found.iterdir()) == ["card.json", "twin.json"]
    assert there.folder(named) == found
    shutil.rmtree(found)
    Objects(url).delete([f"folders/{found.name}.json"])
    with pytest.raises(DamagedFileError, match=r"folders/.* is missing or damaged"):
        there.folder(named)


def test_a_driver_on_another_machine_reuses_everything(url: str, on: Elsewhere, log: Path) -> None:
    plan = Plan(diamond(log, pause=0.0))
    on("here")
    run(store_at(copy_of(url), drives=True), plan)
    on("elsewhere")
    there = store_at(copy_of(url), drives=True)
    outcome = run(there, plan)
    assert (len(outcome.finished), len(outcome.reused)) == (0, 9)
    assert all(there.intact(n.key, large=True) for n in plan)
    assert not Objects(url).sizes("locks")
    assert not Objects(url).sizes("work")


def test_an_input_made_again_to_other_bytes_makes_all_stores_doubt(
    url: str, on: Elsewhere, log: Path
) -> None:
    (log / "number").write_text("1", encoding="utf-8")
    source = node("number_of_a_file", "source", log)
    plan = Plan([node("total", "sum", log, {"a": source})])
    on("here")
    here = store_at(copy_of(url), drives=True)
    run(here, plan)
    (log / "number").write_text("2", encoding="utf-8")
    objects = Objects(url)
    objects.delete(objects.sizes(f"nodes/{source.key}"))  # as if it had been damaged
    shutil.rmtree(here.path(source.key))
    on("elsewhere")
    there = store_at(copy_of(url), drives=True)
    outcome = run(there, plan)
    assert len(outcome.finished) == 2
    on("here")
    found = audit(plan, here)
    assert found.finished == {n.key for n in plan}
    (last,) = (n for n in plan if n.name == "sum")
    assert read_json(here.path(last.key) / "value.json") == 2.0


def test_damage_that_only_the_shared_store_has_is_refused_where_that_is_wanted(
    url: str, on: Elsewhere, log: Path
) -> None:
    source = node("number", "source", log, number=1)
    plan = Plan([node("total", "sum", log, {"a": source})])
    (last,) = (n for n in plan if n.name == "sum")
    on("here")
    run(store_at(copy_of(url), drives=True), plan)
    objects = Objects(url)
    for damaged in (source, last):
        objects.write(f"nodes/{damaged.key}/node.json", b"{")
    on("elsewhere")
    said = f"nodes/{source.key} of {url} cannot be used: it is not what was written"
    there = store_at(copy_of(url), drives=True, repairs=False)
    with pytest.raises(StoreError, match=r"\(1 more like it\); runner\.repair=refuse leaves"):
        audit(plan, there).refuse()
    display, executor = Display(), SerialExecutor()
    with there.driven("sweep"), pytest.raises(StoreError, match=f"{said}, of toys source"):
        run_plan(plan, there, NullTracker(), display, executor=executor, repairs=False)
    # What is damaged after the plan was made, a worker finds.
    call = there.sent(GroupCall.of("sum", there.root, [last], repairs=False))
    assert "is not what was written; runner.repair=recomp" in run_group(call).failed[last.key]
    objects.delete(objects.sizes(f"nodes/{last.key}"))
    assert run_group(call).damaged == {source.key: said}
    assert objects.read(f"nodes/{source.key}/node.json") == b"{"
    assert not objects.sizes("damaged")
    again = run(store_at(copy_of(url), drives=True), plan)
    assert (again.exit_code, len(again.finished)) == (0, 2)


def test_only_one_machine_drives_a_sweep(url: str, on: Elsewhere) -> None:
    on("here")
    here = store_at(copy_of(url), drives=True)
    with here.driven("sweep"):
        on("elsewhere")
        there = store_at(copy_of(url), drives=True)
        there._claims._pause = lambda seconds: here._claims.beat()
        said = r"Another process is running the sweep 'sweep' in .* \(process \d+ on "
        with pytest.raises(PipelineError, match=said), there.driven("sweep"):
            pass
        with there.driven("another"):
            pass
    with there.driven("sweep"):
        pass


def test_addresses_and_copies_lead_to_each_other(cache: Path) -> None:
    for url in ("s3://bucket/some/prefix", "file:///shared/folder", "gs://b", "abfs://c@a/x y"):
        assert address_of(copy_of(f"{url}/")) == url
    assert address_of(Path("mlruns")) is None
    assert address_of(cache / "stores") is None


def test_a_protocol_that_is_not_there_is_one_sentence(cache: Path) -> None:
    with pytest.raises(StoreError, match=r"store=nonsense://x cannot be used \(.*\): install what"):
        SharedStore("nonsense://x")


def test_a_bucket_that_is_not_there_is_one_sentence(s3: dict[str, str], url: str) -> None:
    if not url.startswith("s3"):
        pytest.skip("only a bucket may be missing")
    store = SharedStore("s3://no-such-bucket-here/x", "us")
    with pytest.raises(StoreError, match=r"store=s3://no-such.*does not answer.*check the address"):
        make(store, A)


def test_a_name_that_leads_out_of_the_store_is_not_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    objects = Objects("memory://shelf")
    names = {"/shelf/sweeps/a.json": {"size": 2}, "/shelf/sweeps/../../b.json": {"size": 1}}
    listing = SimpleNamespace(find=lambda path, detail: names)
    monkeypatch.setattr(objects, "_fs", listing)
    assert objects.sizes("sweeps") == {"sweeps/a.json": 2}
