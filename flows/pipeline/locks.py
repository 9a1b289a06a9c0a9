"""Locks between processes; the kernel releases them when their holder dies.

The package filelock is not used. On Unix it leaves the lock file behind, and a store would gather
one per node ever computed; it polls instead of waiting in the kernel; and on a disk without `flock`
it falls back to a mere file, which a killed process leaves behind for ever.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["Lock", "locked"]


class Lock:
    """An exclusive lock named by a file. Not reentrant.

    Args:
        path: The lock file; made if missing.
        keep: Whether the file stays after the release. That saves two changes of the disk where a
            lock is taken hundreds of times.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        self._path = path
        self._keep = keep
        self._handle: int | None = None

    def acquire(self, *, wait: bool = True) -> bool:
        """Takes the lock.

        Args:
            wait: Whether to wait for another holder.

        Returns:
            Whether the lock is held; False only if `wait` is False and another process holds it.
        """
        while True:
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                os.close(handle)
                return False
            except BaseException:
                os.close(handle)
                raise
            # The former holder may have removed the file while we waited: then ours locks nothing.
            with suppress(FileNotFoundError):
                if os.stat(self._path).st_ino == os.fstat(handle).st_ino:
                    self._handle = handle
                    return True
            os.close(handle)

    def release(self) -> None:
        """Gives the lock back; does nothing if it is not held."""
        if self._handle is None:
            return
        if not self._keep:
            # While the lock is still held, so that no other holder's file is removed.
            with suppress(OSError):
                os.unlink(self._path)
        handle, self._handle = self._handle, None
        os.close(handle)


@contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Holds a lock for the length of a `with` block.

    Args:
        path: The lock file; made if missing and removed afterwards.
        wait: Whether to wait for another holder.

    Yields:
        Whether the lock is held; False only if `wait` is False and another process holds it.
    """
    lock = Lock(path)
    held = lock.acquire(wait=wait)
    try:
        yield held
    finally:
        lock.release()
