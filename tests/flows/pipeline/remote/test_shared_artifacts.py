"""Nothing finished is lost and nothing half is finished, whatever ends after whichever operation.

Two machines: `here` has a sound copy or has just made it, `there` has none and looks.
"""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import count
from pathlib import Path

import pytest

from components.core.sealed import RECORD, seal
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.shared_store import SharedStore
from tests.flows.pipeline.remote.cuts import cuts
from tests.flows.pipeline.toys import record_of

A = "a" * 32
FILES = ("deep/file", "other")
LARGE = 70_000  # bytes: more than what is hashed at every look


class Twins:
    """A shared store and its copies, made anew for every attempt."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, count()
        self.again()

    def again(self) -> None:
        self._place = self._folder / str(next(self._number))
        self.objects = Objects(f"file://{self._place}/shared")

    def store(
        self, name: str, *, owner: str = "us", drives: bool = False, repairs: bool = True
    ) -> SharedStore:
        """The store as a process on the machine of this name opens it."""
        place = self._place / name
        store = SharedStore(self.objects.url, owner, drives=drives, repairs=repairs, root=place)
        store._claims._pause = lambda seconds: pytest.fail("nobody may have to wait")
        return store

    def damage(self, what: str) -> None:
        """Damages the shared artifact."""
        match what:
            case "lost":
                self.objects.delete(self.objects.sizes("nodes"))
            case "record":
                self.objects.write(f"nodes/{A}/{RECORD}", b"{")
            case "file":
                self.objects.write(f"nodes/{A}/other", b"damage".ljust(LARGE))
            case "file lost":
                self.objects.delete([f"nodes/{A}/other"])

    def content(self, *folders: str) -> dict[str, bytes]:
        """All files below these."""
        found = (file for folder in folders for file in (self._place / folder).rglob("*"))
        return {str(file): file.read_bytes() for file in found if file.is_file()}

    def look(self) -> str | None:
        """What another machine finds, which may be nothing but never half of something."""
        there = self.store("there", owner="")
        there.fetch([A])
        found = text_of(there)
        shutil.rmtree(there.root)
        return found

    def listed(self) -> bool:
        """Whether the shared store counts it as finished; then it lacks nothing."""
        content = self.objects.read(f"nodes/{A}/{RECORD}")
        if content is None:
            return False
        sizes = self.objects.sizes(f"nodes/{A}")
        files = json.loads(content)["files"]
        assert all(sizes[f"nodes/{A}/{name}"] == files[name]["size"] for name in FILES)
        return True


@pytest.fixture
def twins(tmp_path: Path) -> Twins:
    return Twins(tmp_path)


def made(store: SharedStore, text: str) -> Path:
    folder = store.work / "made"
    for name in FILES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        size = LARGE if name == "other" else 0
        (folder / name).write_text(text.ljust(size), encoding="utf-8")
    seal(folder, record_of(A, text=text))
    return folder


def published(store: SharedStore, text: str) -> None:
    with store.locked([A]):
        store.publish(made(store, text), A)


def text_of(store: SharedStore) -> str | None:
    if not store.path(A).exists():
        return None
    assert store.check(A, fresh=True)["text"]
    return (store.path(A) / "other").read_text(encoding="utf-8").strip()


def publish_made(store: SharedStore) -> None:
    if (store.work / "made").exists():  # as `publish_ready` does
        with store.locked([A]):
            store.publish(store.work / "made", A)


def test_a_publication_that_ends_early_is_whole_or_not_there(twins: Twins) -> None:
    def begin() -> SharedStore:
        twins.again()
        store = twins.store("here")
        made(store, "first")
        return store

    for _ in cuts(begin, publish_made):
        assert twins.look() == ("first" if twins.listed() else None)
        again = twins.store("here")
        publish_made(again)
        again.fetch([A])
        assert (text_of(again), twins.look()) == ("first", "first")


@pytest.mark.parametrize("damage", ["record", "file", "file lost", "none"])
def test_what_has_been_made_outlives_a_damaged_one_in_its_place(twins: Twins, damage: str) -> None:
    def begin() -> SharedStore:
        twins.again()
        published(twins.store("elsewhere"), "first")
        twins.damage(damage)
        store = twins.store("here")
        made(store, "second")
        return store

    expected = "first" if damage == "none" else "second"
    for _ in cuts(begin, publish_made):
        assert twins.look() in ((expected,) if damage == "none" else (expected, None))
        if (twins.objects.read(f"nodes/{A}/other") or b"").startswith(b"second"):
            record = twins.objects.read(f"nodes/{A}/{RECORD}")
            assert record is None or json.loads(record)["text"] == "second"
        again = twins.store("here")
        publish_made(again)
        again.fetch([A])
        assert (text_of(again), twins.look()) == (expected, expected)


@pytest.mark.parametrize("damage", ["lost", "record", "file", "file lost"])
@pytest.mark.parametrize("role", ["driver", "worker", "worker with the lock", "reader"])
def test_a_sound_copy_outlives_and_mends_the_shared_one(
    twins: Twins, damage: str, role: str
) -> None:
    def opened() -> SharedStore:
        store = twins.store("here", owner="" if role == "reader" else "us", drives=role == "driver")
        store._mends = role != "reader"
        return store

    def begin() -> SharedStore:
        twins.again()
        published(twins.store("here"), "first")
        twins.damage(damage)
        if damage in ("file", "file lost"):  # only who has another record looks at files
            record = json.loads(twins.objects.read(f"nodes/{A}/{RECORD}") or b"")
            twins.objects.write(f"nodes/{A}/{RECORD}", json.dumps(record).encode())
        return opened()

    def act(store: SharedStore) -> None:
        if role == "worker with the lock":
            with store.locked([A]):
                store.fetch([A])
        else:
            store.fetch([A])

    for _ in cuts(begin, act):
        assert text_of(twins.store("here")) == "first"
        assert twins.look() in ("first", None)
        act(opened())
        assert text_of(twins.store("here")) == "first"
        assert twins.look() == (None if role == "reader" else "first")


@pytest.mark.parametrize("damage", ["record", "file", "file lost"])
@pytest.mark.parametrize("role", ["driver", "worker", "reader"])
@pytest.mark.parametrize("copy", ["none", "damaged"])
def test_who_repairs_nothing_names_what_is_damaged_and_leaves_it(
    twins: Twins, damage: str, role: str, copy: str
) -> None:
    published(twins.store("elsewhere"), "first")
    here = twins.store("here", owner="" if role == "reader" else "us", repairs=False)
    here.drives = role == "driver"
    here._mends = role != "reader"
    if copy == "damaged":
        here.fetch([A])
        (here.path(A) / "other").write_text("too short", encoding="utf-8")
    twins.damage(damage)
    before = twins.content("shared", "here/nodes")
    here.fetch([A])
    assert here.refused[A].startswith(f"nodes/{A} of {twins.objects.url} cannot be used")
    assert twins.content("shared", "here/nodes") == before
    assert not here.damaged.exists()
    published(twins.store("third"), "again")  # by somebody who repairs
    here.fetch([A])
    assert not here.refused
    assert text_of(here) == "again"


@pytest.mark.parametrize("sound", [True, False])
def test_who_repairs_nothing_still_gives_back_what_was_lost(twins: Twins, sound: bool) -> None:
    published(twins.store("here"), "first")
    twins.damage("lost")
    here = twins.store("here", repairs=False)
    if not sound:
        (here.path(A) / "other").write_text("too short", encoding="utf-8")
    here.fetch([A])
    assert not here.refused
    assert twins.listed() == sound
    assert here.path(A).is_dir()  # where a plan finds the damage


def test_a_copy_stays_until_the_other_one_has_come(twins: Twins) -> None:
    def begin() -> SharedStore:
        twins.again()
        published(twins.store("here"), "old")
        twins.damage("lost")
        published(twins.store("elsewhere"), "new")
        return twins.store("here")

    for _ in cuts(begin, lambda store: store.fetch([A])):
        assert text_of(twins.store("here")) in ("old", "new")
        assert twins.look() == "new"
        again = twins.store("here")
        again.fetch([A])
        assert text_of(again) == "new"


def set_aside(store: SharedStore) -> None:
    with store.locked([A]):
        store.set_aside(A, store.place(A))


def test_a_stale_one_goes_everywhere_and_does_not_come_back(twins: Twins) -> None:
    def begin() -> SharedStore:
        twins.again()
        published(twins.store("elsewhere"), "stale")
        store = twins.store("here", drives=True)
        store.fetch([A])
        return store

    for _ in cuts(begin, set_aside):
        assert twins.look() == ("stale" if twins.listed() else None)
        again = twins.store("here", drives=True)
        again._mends = True
        again.fetch([A])
        set_aside(again)
        assert not twins.listed()
        elsewhere = twins.store("elsewhere")  # whose sound copy would mend the shared store
        elsewhere.fetch([A])
        assert (text_of(elsewhere), twins.listed()) == (None, False)
        assert (elsewhere.damaged / A / RECORD).exists()
        published(elsewhere, "made again")
        again.fetch([A])
        assert (text_of(again), twins.look()) == ("made again", "made again")


def test_a_damaged_one_goes_in_an_order_that_leaves_nothing_half(twins: Twins) -> None:
    def begin() -> SharedStore:
        twins.again()
        published(twins.store("elsewhere"), "first")
        twins.damage("file")
        return twins.store("here")

    for _ in cuts(begin, lambda store: store.fetch([A])):
        assert (twins.look(), twins.listed()) in ((None, True), (None, False))
        twins.store("here").fetch([A])
        assert not twins.listed()
        assert twins.objects.read(f"damaged/{A}/{RECORD}") is not None


@pytest.mark.parametrize("by", ["reader", "worker"])
def test_what_was_replaced_while_it_was_read_stays(twins: Twins, by: str) -> None:
    published(twins.store("elsewhere"), "old")
    reader = twins.store("here", owner="they" if by == "worker" else "")
    pull = reader._folders.pull_artifact

    def replaced(*words: object) -> None:
        reader._folders.pull_artifact = pull  # type: ignore[method-assign]
        twins.damage("lost")
        published(twins.store("third"), "new")
        pull(*words)  # type: ignore[arg-type]

    reader._folders.pull_artifact = replaced  # type: ignore[method-assign, assignment]
    reader.fetch([A])
    assert (text_of(reader), twins.look()) == ("new", "new")


def test_what_another_one_is_making_is_left_to_it(twins: Twins) -> None:
    published(twins.store("elsewhere"), "first")
    twins.damage("file")
    other = twins.store("elsewhere", owner="they")
    other._claims.beat()
    us = twins.store("here")
    with other.locked([A]):
        us.fetch([A])
        assert twins.listed()  # who makes it again puts it in its place
        us.publish(made(us, "ours"), A)
        assert (us.work / "made").exists()
    us.publish(us.work / "made", A)
    assert (text_of(us), twins.look()) == ("ours", "ours")


def test_what_came_before_one_could_mend_stays(twins: Twins) -> None:
    published(twins.store("here"), "first")
    twins.damage("lost")
    here = twins.store("here")
    alone = here._claims.alone

    def after_another(key: str) -> AbstractContextManager[bool]:
        published(twins.store("elsewhere"), "second")
        return alone(key)

    here._claims.alone = after_another  # type: ignore[method-assign]
    here.fetch([A])
    assert twins.look() == "second"


def test_only_the_one_that_was_judged_is_taken_away(twins: Twins) -> None:
    driver = twins.store("here", drives=True)
    published(driver, "stale")
    twins.damage("lost")
    published(twins.store("elsewhere"), "made again")
    set_aside(driver)
    assert twins.look() == "made again"


def test_a_driver_mends_once_it_drives(twins: Twins) -> None:
    published(twins.store("here"), "first")
    twins.damage("lost")
    driver = twins.store("here", drives=True)
    driver.fetch([A])
    assert (text_of(driver), twins.listed()) == ("first", False)
    with driver.driven("sweep"):
        assert twins.look() == "first"


def test_a_worker_brings_again_what_its_disk_has_damaged(twins: Twins) -> None:
    published(twins.store("here"), "first")
    (twins.store("here").path(A) / "other").write_text("damaged".ljust(LARGE), encoding="utf-8")
    worker = twins.store("here")
    worker.fetch([A])
    assert text_of(worker) == "first"


@pytest.mark.parametrize("act", [publish_made, lambda store: store.fetch([A])])
def test_nothing_is_left_of_what_was_replaced(
    twins: Twins, act: Callable[[SharedStore], None]
) -> None:
    published(twins.store("here"), "old")
    twins.damage("lost")
    published(twins.store("elsewhere"), "new")
    here = twins.store("here")
    made(here, "third")
    act(here)
    assert text_of(here) == "new"
    assert list((here.root / "arriving").iterdir()) == []
