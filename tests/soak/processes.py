"""The processes that the soak has started: its descendants, and nobody else's.

Linux hands an orphan to the nearest ancestor that asked for them. The soak asks, so that what a
killed driver leaves behind stays a descendant and can be found, ended and waited for.
"""

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Process", "adopt_orphans", "descendants", "end_all", "reap", "shared_memory"]

_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of linux/prctl.h


@dataclass(frozen=True)
class Process:
    """A living process.

    Attributes:
        pid: Its id.
        parent: That of its parent.
        name: What it was started as; Ray's workers name their task here.
    """

    pid: int
    parent: int
    name: str


def adopt_orphans() -> None:
    """Makes this process the parent of its descendants' orphans.

    Raises:
        OSError: the kernel does not know that.
    """
    if ctypes.CDLL(None, use_errno=True).prctl(_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "this kernel hands no orphans to their grandparents")


def descendants(of: int | None = None) -> list[Process]:
    """Living descendants of a process, by default of this one; zombies are dead."""
    children: dict[int, list[Process]] = {}
    for process in _living():
        children.setdefault(process.parent, []).append(process)
    found, left = [], [of or os.getpid()]
    while left:
        below = children.get(left.pop(), [])
        found += below
        left += [process.pid for process in below]
    return found


def _living() -> Iterator[Process]:
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):  # it may end meanwhile
                state, parent = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
                words = (folder / "cmdline").read_bytes().split(b"\0")
                if state not in "ZX":
                    yield Process(int(folder.name), int(parent), words[0].decode(errors="replace"))


def reap(known: set[int]) -> None:
    """Takes the exit codes of adopted orphans that have ended; `known` ones have who waits."""
    tasks = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    for pid in set(map(int, tasks)) - known:
        with suppress(OSError):
            os.waitpid(pid, os.WNOHANG)


def end_all(of: int | None = None) -> int:
    """Kills all living descendants; how many there were."""
    found = descendants(of)
    for process in found:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)
    return len(found)


def shared_memory() -> set[str]:
    """Names of this user's shared memory that no living process has mapped."""
    ours = {entry.name for entry in os.scandir("/dev/shm") if entry.stat().st_uid == os.getuid()}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):
                mapped = (folder / "maps").read_text(errors="replace")
                ours -= {name for name in ours if f"/dev/shm/{name}" in mapped}
    return ours
