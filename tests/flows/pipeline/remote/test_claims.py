"""Claims hold as long as their driver gives signs of life, by the clock of whoever waits."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flows.pipeline.remote.claims import SILENCE, Claims
from flows.pipeline.remote.objects import Objects


class Clock:
    """A clock that goes on when somebody waits."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def objects(tmp_path: Path) -> Objects:
    return Objects(f"file://{tmp_path}/shared")


@pytest.fixture
def clock() -> Clock:
    return Clock()


def ours(objects: Objects, clock: Clock, owner: str = "us") -> Claims:
    made = Claims(objects, owner, clock, clock.wait)
    made.beat()
    return made


def far(objects: Objects, sign: str) -> None:
    """A sign of life of a driver `far` on another machine."""
    about = {"host": "another-machine", "processes": "there", "pid": 1, "sign": sign}
    objects.write("locks/far.beat", json.dumps(about).encode())


def test_of_two_drivers_one_has_a_node_and_all_or_nothing_is_taken(
    objects: Objects, clock: Clock
) -> None:
    one, two = ours(objects, clock), ours(objects, clock, "they")
    assert one.take(["b"]) == ["b"]
    assert two.take(["a", "b"], wait=False) == []
    assert one.take(["a", "b"], wait=False) == ["a", "b"]  # also another worker of the same driver
    one.give_back(["a", "b"])
    assert two.take(["a", "b"], wait=False) == ["a", "b"]


def test_a_driver_that_gives_no_sign_loses_its_claims_after_a_minute(
    objects: Objects, clock: Clock
) -> None:
    objects.write("locks/a.claim", b"far")
    far(objects, "first")
    claims = ours(objects, clock)
    assert claims.take(["a"], wait=False) == []
    clock.wait(SILENCE - 1)
    far(objects, "second")
    assert claims.take(["a"], wait=False) == []
    clock.wait(SILENCE - 1)
    assert claims.take(["a"], wait=False) == []
    clock.wait(2)
    assert claims.take(["a"], wait=False) == ["a"]
    assert objects.read("locks/far.beat") is None  # others need not wait again


def test_who_waits_gets_the_claim_in_the_end(objects: Objects, clock: Clock) -> None:
    objects.write("locks/a.claim", b"far")
    far(objects, "last")
    assert ours(objects, clock).take(["a"]) == ["a"]
    assert SILENCE <= clock.now < SILENCE + 5


def test_a_claim_without_a_driver_is_free_at_once(objects: Objects, clock: Clock) -> None:
    objects.write("locks/a.claim", b"nobody")
    assert ours(objects, clock).take(["a"], wait=False) == ["a"]


def test_a_process_of_this_machine_that_has_ended_is_known_at_once(
    objects: Objects, clock: Clock, tmp_path: Path
) -> None:
    program = (
        "from flows.pipeline.remote.claims import Claims\n"
        "from flows.pipeline.remote.objects import Objects\n"
        f"claims = Claims(Objects({objects.url!r}), 'gone'); claims.beat(); claims.take(['a'])"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert objects.read("locks/a.claim") == b"gone"
    assert ours(objects, clock).take(["a"], wait=False) == ["a"]
    assert clock.now == 0.0


def test_an_end_leaves_nothing_but_what_living_drivers_hold(objects: Objects, clock: Clock) -> None:
    far(objects, "alive")
    objects.write("locks/a.claim", b"far")
    objects.write("locks/b.claim", b"nobody")
    claims = ours(objects, clock)
    claims.take(["c"])
    claims.end()
    assert sorted(objects.sizes("locks")) == ["locks/a.claim", "locks/far.beat"]


def test_a_claim_that_is_being_written_is_not_taken_for_one_of_a_dead_driver(
    objects: Objects, clock: Clock
) -> None:
    objects.write("locks/a.claim", b"")  # where a store makes a name first and fills it then
    claims = ours(objects, clock)
    assert claims.take(["a"], wait=False) == []
    claims.end()
    assert objects.read("locks/a.claim") == b""
    assert ours(objects, clock).take(["a"]) == ["a"]  # its writer has died
    assert SILENCE <= clock.now < SILENCE + 5


def test_a_file_is_created_once_and_never_seen_empty(
    objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another one writes in the instant in which one has seen that nothing is there."""
    exists = objects._fs.exists

    def just_before(path: str, **words: object) -> bool:
        found = bool(exists(path, **words))
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_bytes(b"they")
        return found

    monkeypatch.setattr(objects._fs, "exists", just_before)
    seen = []
    link = os.link

    def linked(source: str, target: str) -> None:
        seen.append(objects.read("locks/a.claim"))
        just_before(target)
        link(source, target)

    monkeypatch.setattr(os, "link", linked)
    assert not objects.create("locks/a.claim", b"we")
    assert objects.read("locks/a.claim") == b"they"
    assert seen == [None]
    assert list(objects.sizes("locks")) == ["locks/a.claim"]


def test_a_disk_without_second_names_creates_a_file_once(
    objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(source: str, target: str) -> None:
        raise PermissionError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refused)
    assert objects.create("locks/a.claim", b"we")
    assert not objects.create("locks/a.claim", b"they")
    assert objects.read("locks/a.claim") == b"we"


def test_without_an_owner_or_a_name_nothing_is_written(objects: Objects, clock: Clock) -> None:
    nobody = Claims(objects, "", clock, clock.wait)
    for act in (nobody.beat, lambda: nobody.take(["a"]), lambda: nobody.outlive("a")):
        with pytest.raises(ValueError, match="has nobody to claim for"):
            act()
    with pytest.raises(ValueError, match="has nobody to claim for"), nobody.alone("a"):
        pass
    assert nobody.take([]) == []
    with ours(objects, clock).held([]) as held:
        assert held
    assert list(objects.sizes("locks")) == ["locks/us.beat"]


def test_one_process_alone_keeps_out_the_workers_of_its_own_driver(
    objects: Objects, clock: Clock
) -> None:
    one, two = ours(objects, clock), ours(objects, clock)
    with one.alone("a") as alone:
        assert alone
        assert two.take(["a"], wait=False) == []
        with two.alone("a") as also:
            assert not also
    assert two.take(["a"], wait=False) == ["a"]
    with one.alone("a") as alone:
        assert not alone
    assert objects.read("locks/a.claim") == b"us"


def test_one_that_died_alone_is_not_waited_for_as_long_as_its_driver_lives(
    objects: Objects, clock: Clock
) -> None:
    objects.write("locks/a.claim", b"us number")
    claims = ours(objects, clock)
    claims._pause = lambda seconds: (clock.wait(seconds), claims.beat())
    assert claims.take(["a"]) == ["a"]
    assert SILENCE < clock.now < 2000


def test_an_end_spares_a_driver_that_has_just_begun(
    objects: Objects, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long list of names comes in pages, and what is new may stand on either side."""
    claims = ours(objects, clock)
    sizes = objects.sizes

    def in_pages(prefix: str) -> dict[str, int]:
        first = sizes(prefix)
        far(objects, "sign")
        objects.write("locks/z.claim", b"far")
        return first | {"locks/z.claim": 3}

    monkeypatch.setattr(objects, "sizes", in_pages)
    claims.end()
    assert objects.read("locks/z.claim") == b"far"
