"""One process per sweep: two would write into one record."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flows.pipeline.errors import TrackingError
from flows.pipeline.locks import locked

__all__ = ["check_sweep_name", "hold_sweep", "is_held"]


def check_sweep_name(name: str) -> None:
    """Checks the name of a sweep, which is part of file names and searches.

    Raises:
        ValueError: it holds anything but letters, digits, `_`, `-`, `.`.
    """
    if not re.fullmatch(r"[\w.-]+", name, flags=re.ASCII):
        raise ValueError(
            f"The sweep name {name!r} may hold letters, digits, '_', '-' and '.' only."
        )


@contextmanager
def hold_sweep(root: Path, name: str) -> Iterator[None]:
    """Holds the lock of a sweep for the length of a `with` block.

    Args:
        root: Folder of the store.
        name: Name of the sweep.

    Raises:
        TrackingError: another process is running this sweep.
        ValueError: the name holds anything but letters, digits, `_`, `-`, `.`.
    """
    check_sweep_name(name)
    path = _lock(root, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path, wait=False) as held:
        if not held:
            raise TrackingError(
                f"Another process is running the sweep {name!r}: "
                "wait for it, stop it, or give this sweep another name."
            )
        yield


def is_held(root: Path, name: str) -> bool:
    """Whether a process holds the lock of a sweep; for a name that is none, no process does.

    Args:
        root: Folder of the store, with its folder of locks.
        name: Name of the sweep.
    """
    try:
        check_sweep_name(name)
    except ValueError:
        return False
    with locked(_lock(root, name), wait=False) as free:
        return not free


def _lock(root: Path, name: str) -> Path:
    return root / "locks" / f"sweep-{name}.lock"
