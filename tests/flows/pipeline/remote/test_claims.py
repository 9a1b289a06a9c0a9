"""Claims hold as long as their driver gives signs of life, by the clock of whoever waits."""

import json
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
