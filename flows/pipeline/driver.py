"""What the driver of a sweep tells others about itself, and how they ask it to stop.

STORE/drivers/NAME.json   what it does, written every few seconds; how it ended
STORE/drivers/NAME.stop   asks the driver of this id to stop

A killed driver leaves its record as it was. On its own machine the lock that it held tells, which
the kernel gives back; elsewhere the age of its last sign of life does.
"""

import fcntl
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from components.core.files import read_json, write_json, write_text
from flows.pipeline.errors import PipelineError
from flows.pipeline.failures import failure_line
from flows.pipeline.locks import Lock
from flows.pipeline.outcome import Outcome
from flows.pipeline.store import ArtifactStore

__all__ = [
    "Driver",
    "DriverRecord",
    "ask_to_stop",
    "driving",
    "is_alive",
    "is_driven",
    "read_driver",
]

_BETWEEN = 1.0  # least seconds between two records
_BEAT = 5.0  # seconds after which a record is written without a change
_SILENCE = 120.0  # seconds without one after which a driver on another machine is gone
_TRIES, _PAUSE = 10, 0.05  # for the lock, which somebody who looks holds for an instant


@dataclass(frozen=True)
class DriverRecord:
    """The state of a driver at one moment.

    Attributes:
        name: Of its sweep.
        id: Its own, for requests that must not reach another one.
        command: How to continue.
        host: The machine it runs on.
        pid: Its process there.
        began: Seconds since 1970.
        beat: When this was written, in seconds since 1970.
        slots: Groups that run at once.
        device: "cpu" or "cuda".
        limit: When it stops by itself, as words.
        running: Keys of the groups that an executor has taken, by group.
        failed: Last line of the reason, by key.
        skipped: By key of a node not run, the key of the failed one it needs.
        stopping: Why it is stopping, or has stopped; empty if it was not asked to.
        ended: FINISHED, FAILED or KILLED; empty while it runs.
    """

    name: str
    id: str
    command: str
    host: str
    pid: int
    began: float
    beat: float
    slots: int = 1
    device: str = "cpu"
    limit: str = ""
    running: Mapping[str, list[str]] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    stopping: str = ""
    ended: str = ""


class Driver:
    """The voice and the ears of a running driver.

    Attributes:
        status: How the sweep ends, for the last record.
    """

    def __init__(
        self,
        root: Path,
        record: DriverRecord,
        limit: Callable[[], str] = lambda: "",
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Takes what others can know from the start; `driving` makes one.

        Args:
            root: Folder of the store.
            record: The first record.
            limit: Why to stop by itself, as a clause; empty while there is no reason.
            clock: Seconds since 1970.
        """
        self.status = "FAILED"
        self._root, self._record, self._limit, self._clock = root, record, limit, clock
        self._written = float("-inf")

    def reason_to_stop(self) -> str:
        """Why to stop now, as a clause; empty while there is no reason."""
        with suppress(OSError):
            if _request(self._root, self._record.name).read_text("utf-8") == self._record.id:
                return "flows.stop asked for it"
        return self._limit()

    def tell(
        self,
        outcome: Outcome,
        running: Mapping[str, list[str]],
        slots: int,
        device: str,
        stopping: str,
        last: bool = False,
    ) -> None:
        """Writes what has changed, or a sign of life; a disk that is full is no reason to end.

        Args:
            outcome: Of the run so far.
            running: Keys of the groups that an executor has taken, by group.
            slots: Groups that run at once.
            device: "cpu" or "cuda".
            stopping: Why the run is stopping; empty if it is not.
            last: Whether to write in any case.
        """
        silent = self._clock() - self._record.beat
        if 0.0 <= silent < _BETWEEN and not last:
            return
        state = replace(
            self._record,
            slots=slots,
            device=device,
            running=dict(running),
            failed={key: failure_line(reason) for key, reason in outcome.failed.items()},
            skipped=dict(outcome.skipped),
            stopping=stopping,
        )
        if last or state != self._record or not 0.0 <= silent < _BEAT:
            self.write(state)

    def end(self) -> None:
        """Writes the last record and forgets requests."""
        self.write(replace(self._record, running={}, ended=self.status))
        with suppress(OSError):
            _request(self._root, self._record.name).unlink(missing_ok=True)

    def write(self, record: DriverRecord | None = None) -> None:
        """Writes a record as of now."""
        self._record = replace(record or self._record, beat=self._clock())
        with suppress(OSError):
            path = _path(self._root, self._record.name)
            path.parent.mkdir(exist_ok=True)
            write_json(path, asdict(self._record))


@contextmanager
def driving(
    store: ArtifactStore,
    name: str,
    command: str,
    limit: Callable[[], str] = lambda: "",
    limited: str = "",
) -> Iterator[Driver]:
    """Tells others, for the length of a `with` block, that this process drives a sweep.

    Args:
        store: The store.
        name: Of the sweep.
        command: How to continue it.
        limit: Why to stop by itself, see `Driver`.
        limited: When that is, as words.

    Raises:
        PipelineError: another process drives it.
    """
    lock = Lock(_lock(store.root, name))
    if not any(_acquired(lock, number) for number in range(_TRIES)):
        raise PipelineError(
            f"Another process is running the sweep {name!r}: "
            "wait for it, stop it, or give this sweep another name."
        )
    now, host = time.time(), socket.gethostname()
    record = DriverRecord(
        name, secrets.token_hex(8), command, host, os.getpid(), now, now, limit=limited
    )
    driver = Driver(store.root, record, limit)
    try:
        _request(store.root, name).unlink(missing_ok=True)
        driver.write()
        yield driver
    finally:
        driver.end()
        lock.release()


def read_driver(root: Path, name: str) -> DriverRecord | None:
    """What the present or last driver of a sweep has told; None if there is nothing readable."""
    value: Any = read_json(_path(root, name))
    try:
        return DriverRecord(**value)
    except TypeError:  # of another version, or damaged
        return None


def is_alive(root: Path, record: DriverRecord, now: float) -> bool:
    """Whether a driver still runs.

    Args:
        root: Folder of the store.
        record: What it has told last.
        now: Seconds since 1970.
    """
    if record.ended:
        return False
    held = _is_held(_lock(root, record.name))
    if held is not None and (held or record.host == socket.gethostname()):
        return held
    return now - record.beat < _SILENCE


def is_driven(root: Path, name: str) -> bool:
    """Whether a process drives a sweep in this folder, as far as its lock can tell."""
    return _is_held(_lock(root, name)) is True


def ask_to_stop(root: Path, record: DriverRecord, now: float) -> bool:
    """Asks a driver to stop, which looks whenever it looks at its workers.

    Args:
        root: Folder of the store.
        record: What the driver has told last.
        now: Seconds since 1970.

    Returns:
        Whether it runs; nothing is left behind if it does not.

    Raises:
        OSError: the store cannot be written.
    """
    if is_alive(root, record, now):
        write_text(_request(root, record.name), record.id)
        last = read_driver(root, record.name) or record
        if is_alive(root, last, now):  # it may have ended just before it could see this
            return True
    _request(root, record.name).unlink(missing_ok=True)
    return False


def _acquired(lock: Lock, number: int) -> bool:
    if number:
        threading.Event().wait(_PAUSE)
    return lock.acquire(wait=False)


def _is_held(path: Path) -> bool | None:
    """Whether a process holds a lock; None if that cannot be found out."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    except OSError:
        return None
    finally:
        os.close(handle)


def _path(root: Path, name: str) -> Path:
    return root / "drivers" / f"{name}.json"


def _request(root: Path, name: str) -> Path:
    return root / "drivers" / f"{name}.stop"


def _lock(root: Path, name: str) -> Path:
    return root / "locks" / f"driver-{name}.lock"
