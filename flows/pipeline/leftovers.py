"""What killed processes leave in a store, removed by the next one that has the store to itself.

Every driver holds a shared lock on the store as long as it may write. Who can have the lock alone
knows that no other driver lives, so that progress reports, half-written and half-fetched files and
locks without a holder are of use to nobody. Work folders are not touched: their checkpoints are
what a sweep continues from.
"""

import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flows.pipeline.locks import Lock
from flows.pipeline.remote.folders import discard_abandoned
from flows.pipeline.store import ArtifactStore

__all__ = ["store_alone", "store_in_use"]

_LOCK = ".in-use"
_HALF_WRITTEN = re.compile(r"\..+-[0-9a-f]{12}(\.\w+)?")  # see components.core.files
_PROBE = ".probe-"  # of a disk or of the machines of a cluster


@contextmanager
def store_in_use(store: ArtifactStore) -> Iterator[None]:
    """Tells other processes that this one writes into a store, and removes leftovers first."""
    with store_alone(store) as (alone, handle):
        if alone:
            _remove_leftovers(store)
        fcntl.flock(handle, fcntl.LOCK_SH)
        yield


@contextmanager
def store_alone(store: ArtifactStore) -> Iterator[tuple[bool, int]]:
    """Keeps drivers from beginning, if none has the store in use.

    Yields:
        Whether none has, and the open file of the lock.
    """
    handle = os.open(store.locks / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = True
        except BlockingIOError:
            alone = False
        yield alone, handle
    finally:
        os.close(handle)


def _remove_leftovers(store: ArtifactStore) -> None:
    for file in _files(store.root / "progress"):
        _remove(file)
    discard_abandoned(store.root / "arriving")
    for folder in ("drivers", "minari", "optuna", "reports", "sweeps", "tracking", "work"):
        for file in _files(store.root / folder):
            if _HALF_WRITTEN.fullmatch(file.name):
                _remove(file)
    for file in _files(store.locks):
        if file.name.startswith(_PROBE):
            _remove(file)
        elif file.name != _LOCK:
            with suppress(OSError):
                lock = Lock(file)
                if lock.acquire(wait=False):
                    lock.release()  # removes it


def _files(folder: Path) -> list[Path]:
    return [file for file in folder.rglob("*") if file.is_file() and not file.is_symlink()]


def _remove(file: Path) -> None:
    with suppress(OSError):
        file.unlink()
