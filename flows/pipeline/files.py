"""Files that appear whole or not at all, and locks that die with their process."""

import fcntl
import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

__all__ = ["locked", "read_json", "write_json", "write_text"]


def write_text(path: Path, text: str) -> None:
    """Writes text to a temporary neighbour and renames it into place."""
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex[:12]}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Writes JSON to a temporary neighbour and renames it into place."""
    write_text(path, json.dumps(value, indent=1))


def read_json(path: Path) -> Any:
    """Reads a JSON file; None if it is missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


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
