"""Locks in a shared store: claims of drivers, which hold for as long as their driver gives signs.

locks/NAME.claim     whose a node, or a sweep, is: OWNER, and a number if it is one process's alone
locks/OWNER.beat     the driver's sign of life, another one every few seconds

A claim is made by an object that only one of two writers can create. Its owner is the driver, not
one of its workers: the driver knows which of them died and has others go on at once. One whose sign
stays the same for a minute is gone, by the clock of whoever looks, so that clocks need not agree.
One that was only cut off finds its claims taken; what it still finishes is then a result that is
there already, and the first one stays.
"""

import json
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flows.pipeline.remote.objects import Objects

__all__ = ["SILENCE", "Claims"]

SILENCE = 60.0  # seconds without another sign of life after which a driver is gone
_MENDING = 600.0  # seconds after which who holds a name alone has died, though its driver lives
_BETWEEN = 2.0  # seconds between two looks at a claim of another driver


class Claims:
    """The claims of one driver and its workers.

    Attributes:
        owner: The driver's.
    """

    def __init__(
        self,
        objects: Objects,
        owner: str,
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        """Takes the store's objects and whose claims these are; nobody's if only to look."""
        self.owner = owner
        self._objects, self._clock, self._pause = objects, clock, pause
        self._signs: dict[str, tuple[bytes, float]] = {}  # the last one seen, and since when

    def beat(self) -> None:
        """Gives another sign of life.

        Raises:
            StoreError: the store cannot be written.
        """
        self._check_owner()
        sign = {"host": socket.gethostname(), "processes": _processes(), "pid": os.getpid()}
        sign["sign"] = secrets.token_hex(8)
        self._objects.write(_beat(self.owner), json.dumps(sign).encode())

    def take(self, names: Iterable[str], *, wait: bool = True) -> list[str]:
        """Claims all of these, in one order; or none.

        Args:
            names: Of nodes or sweeps.
            wait: Whether to wait for other drivers; one that gives no sign loses its claim.

        Returns:
            The names; none if `wait` is False and another driver that lives has one of them.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        taken = []
        for name in sorted(set(names)):
            if not self._take(name, wait=wait):
                self.give_back(taken)
                return []
            taken.append(name)
        return taken

    def _take(self, name: str, *, wait: bool, content: bytes = b"") -> bool:
        self._check_owner()
        content = content or self.owner.encode()
        while not self._objects.create(_claim(name), content):
            holder = self._objects.read(_claim(name))
            if holder == content:
                return True
            if holder is None:
                continue
            if not self._holds(name, holder):
                # Two that take over in one instant may both compute the node; one result stays.
                if self._objects.read(_claim(name)) == holder:
                    self._objects.delete([_claim(name)])
            elif wait:
                self._pause(_BETWEEN)
            else:
                return False
        return True

    def _check_owner(self) -> None:
        if not self.owner:
            raise ValueError("a store without an owner is only read: it has nobody to claim for")

    @contextmanager
    def alone(self, name: str) -> Iterator[bool]:
        """Claims a name for this process, not for its driver's others; does not wait.

        Yields:
            Whether it is claimed; False also if another worker of the same driver has it.
        """
        content = f"{self.owner} {secrets.token_hex(8)}".encode()
        taken = self._take(name, wait=False, content=content)
        try:
            yield taken
        finally:
            if taken:
                self._give_back([name], content)

    def outlive(self, name: str) -> bool:
        """Claims a name, if its holder gives no other sign of life while one waits for it.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        first = self._sign_of_holder(name)
        while not self._take(name, wait=False):
            if self._sign_of_holder(name) not in (first, b""):
                return False
            self._pause(_BETWEEN)
        return True

    def _sign_of_holder(self, name: str) -> bytes:
        owner = _owner(self._objects.read(_claim(name)) or b"")
        return (owner and self._objects.read(_beat(owner))) or b""

    def _holds(self, name: str, content: bytes) -> bool:
        """Whether a claim with this content may still hold; an empty one may be being written."""
        owner = _owner(content)
        if owner and not self.lives(owner):
            return False
        if content == owner.encode():
            return bool(owner) or self._is_new(_claim(name), content, SILENCE)
        return self._is_new(_claim(name), content, _MENDING)

    def _is_new(self, what: str, sign: bytes, seconds: float) -> bool:
        """Whether a sign has been the same for less than some seconds."""
        known = self._signs.get(what)
        now = self._clock()
        if known is None or known[0] != sign:
            self._signs[what] = sign, now
            return True
        return now - known[1] < seconds

    def lives(self, owner: str) -> bool:
        """Whether a driver may still live: it does until its sign has been the same for a minute.

        One that is found gone loses its sign, so that nobody else has to wait.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        sign = self._objects.read(_beat(owner))
        if sign is None:
            return False
        if self._is_new(_beat(owner), sign, SILENCE) and not _dead_here(sign):
            return True
        self._objects.delete([_beat(owner)])
        return False

    def holder(self, name: str) -> str:
        """Which machine and process has claimed a name, in words."""
        owner = _owner(self._objects.read(_claim(name)) or b"")
        sign = self._objects.read(_beat(owner)) if owner else None
        try:
            about = json.loads(sign or b"")
            return f"process {about['pid']} on {about['host']}"
        except (ValueError, KeyError, TypeError):
            return "another process"

    def give_back(self, names: Iterable[str]) -> None:
        """Gives claims back; those of others stay.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        self._give_back(names, self.owner.encode())

    def _give_back(self, names: Iterable[str], content: bytes) -> None:
        held = self._objects.read_many([_claim(name) for name in names])
        self._objects.delete(claim for claim, written in held.items() if written == content)

    def end(self) -> None:
        """Gives everything back, and removes what drivers that are gone have left.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        self._objects.delete([_beat(self.owner)])
        names = [name for name in self._objects.sizes("locks") if name.endswith(".claim")]
        owners = {
            claim: _owner(content) for claim, content in self._objects.read_many(names).items()
        }
        # In this order: a driver gives its first sign before it claims anything.
        beats = self._objects.read_many({_beat(owner) for owner in owners.values() if owner})
        self._objects.delete(
            c for c, owner in owners.items() if owner and _beat(owner) not in beats
        )

    @contextmanager
    def held(self, names: Iterable[str], *, wait: bool = True) -> Iterator[bool]:
        """Holds claims for the length of a `with` block.

        Yields:
            Whether they are held.
        """
        wanted = set(names)
        taken = self.take(wanted, wait=wait)
        try:
            yield len(taken) == len(wanted)
        finally:
            self.give_back(taken)


def _dead_here(sign: bytes) -> bool:
    """Whether a sign comes from a process of this machine that has ended."""
    try:
        about = json.loads(sign)
        ours = (about["host"], about["processes"]) == (socket.gethostname(), _processes())
        pid = int(about["pid"])
    except (ValueError, KeyError, TypeError):
        return False
    if not ours:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        pass
    return False


def _processes() -> str:
    """Which processes have numbers of their own: those of a container, or of a start of Linux."""
    with suppress(OSError):
        started = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{started} {os.readlink('/proc/self/ns/pid')}"
    return ""


def _owner(content: bytes) -> str:
    """Whose a claim is; empty if it has not been written yet."""
    return content.decode(errors="replace").partition(" ")[0]


def _claim(name: str) -> str:
    return f"locks/{name}.claim"


def _beat(owner: str) -> str:
    return f"locks/{owner}.beat"
