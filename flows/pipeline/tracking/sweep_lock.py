"""One process per sweep: two would write into one record."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flows.pipeline.errors import TrackingError
from flows.pipeline.locks import locked

__all__ = ["hold_sweep"]


@contextmanager
def hold_sweep(root: Path, name: str) -> Iterator[None]:
    """Holds the lock of a sweep for the length of a `with` block.

    Args:
        root: Folder of the store.
        name: Name of the sweep. It is part of file names and searches.

    Raises:
        TrackingError: another process is running this sweep.
        ValueError: the name holds anything but letters, digits, `_`, `-`, `.`.
    """
    if not re.fullmatch(r"[\w.-]+", name, flags=re.ASCII):
        raise ValueError(
            f"The sweep name {name!r} may hold letters, digits, '_', '-' and '.' only."
        )
    locks = root / "locks"
    locks.mkdir(parents=True, exist_ok=True)
    with locked(locks / f"sweep-{name}.lock", wait=False) as held:
        if not held:
            raise TrackingError(
                f"Another process is running the sweep {name!r}: "
                "wait for it, stop it, or give this sweep another name."
            )
        yield
