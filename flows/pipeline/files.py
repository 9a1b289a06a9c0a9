"""Locks that die with their process, beside the files that appear whole or not at all."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from components.core.files import read_json, write_json, write_text

__all__ = ["locked", "read_json", "write_json", "write_text"]


@contextmanager
def locked(path: Path, *, wait: bool = True, remove: bool = True) -> Iterator[bool]:
    """Holds an exclusive lock named by a file, for the length of a `with` block.

    The kernel gives the lock back when the process dies, in whatever way.

    Args:
        path: The lock file; made if missing.
        wait: Whether to wait for another holder.
        remove: Whether to remove the file afterwards.

    Yields:
        Whether the lock is held; False only if `wait` is False and another process holds it.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            os.close(handle)
            yield False
            return
        except BaseException:
            os.close(handle)
            raise
        # The former holder may have removed the file while we waited: then ours locks nothing.
        with suppress(FileNotFoundError):
            if os.stat(path).st_ino == os.fstat(handle).st_ino:
                break
        os.close(handle)
    try:
        yield True
    finally:
        if remove:
            with suppress(OSError):
                os.unlink(path)
        os.close(handle)
