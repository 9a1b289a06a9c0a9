"""Locks in a shared store: claims of drivers, which hold for as long as their driver gives signs.

locks/NAME.claim     whose a node, or a sweep, is
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
        """Takes the store's objects and whose claims these are."""
        self.owner = owner
        self._objects, self._clock, self._pause = objects, clock, pause
        self._signs: dict[str, tuple[bytes, float]] = {}  # the last one seen, and since when

    def beat(self) -> None:
        """Gives another sign of life.

        Raises:
            StoreError: the store cannot be written.
        """
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

    def _take(self, name: str, *, wait: bool) -> bool:
        ours = self.owner.encode()
        while not self._objects.create(_claim(name), ours):
            holder = self._objects.read(_claim(name))
            if holder is None or holder == ours:
                if holder == ours:
                    return True
                continue
            if not self.lives(holder.decode(errors="replace")):
                # Two that take over in one instant may both compute the node; one result stays.
                if self._objects.read(_claim(name)) == holder:
                    self._objects.delete([_claim(name)])
            elif wait:
                self._pause(_BETWEEN)
            else:
                return False
        return True

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
        owner = (self._objects.read(_claim(name)) or b"").decode(errors="replace")
        return (owner and self._objects.read(_beat(owner))) or b""

    def lives(self, owner: str) -> bool:
        """Whether a driver may still live: it does until its sign has been the same for a minute.

        One that is found gone loses its sign, so that nobody else has to wait.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        sign = self._objects.read(_beat(owner))
        if sign is None:
            return False
        known, since = self._signs.get(owner, (b"", 0.0))
        now = self._clock()
        if sign != known:
            self._signs[owner] = sign, now
            since = now
        if now - since < SILENCE and not _dead_here(sign):
            return True
        self._objects.delete([_beat(owner)])
        return False

    def holder(self, name: str) -> str:
        """Which machine and process has claimed a name, in words."""
        owner = (self._objects.read(_claim(name)) or b"").decode(errors="replace")
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
        claims = [_claim(name) for name in names]
        held = self._objects.read_many(claims) if claims else {}
        self._objects.delete(c for c, owner in held.items() if owner == self.owner.encode())

    def end(self) -> None:
        """Gives everything back, and removes what drivers that are gone have left.

        Raises:
            StoreError: the store does not answer or cannot be written.
        """
        self._objects.delete([_beat(self.owner)])
        there = self._objects.sizes("locks")
        claims = self._objects.read_many([name for name in there if name.endswith(".claim")])
        dead = {o.decode(errors="replace") for o in claims.values()}
        dead = {owner for owner in dead if _beat(owner) not in there or owner == self.owner}
        self._objects.delete(c for c, o in claims.items() if o.decode(errors="replace") in dead)

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


def _claim(name: str) -> str:
    return f"locks/{name}.claim"


def _beat(owner: str) -> str:
    return f"locks/{owner}.beat"
