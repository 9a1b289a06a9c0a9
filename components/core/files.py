"""Atomic writes: a file or folder appears complete or not at all.

Everything is written under a temporary name beside its own and renamed when it is complete. An
error removes the temporary file; a killed process leaves it behind, hidden.

A name may reach the disk before the content does, and a power cut in between leaves an empty file.
What must survive one is therefore handed to the disk (`sync`) before it gets its name.
"""

import errno
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = [
    "read_json",
    "replacing",
    "replacing_folder",
    "sync",
    "temporary_name",
    "without_undefined",
    "write_json",
    "write_text",
]


@contextmanager
def temporary_name(path: Path) -> Iterator[Path]:
    """Provide a hidden temporary name beside ``path``, for a file or a folder.

    Args:
        path: The final name. Its suffix is kept, since some writers choose their format by it.

    Yields:
        The temporary name, not in use yet. A file or folder that has it at the end of the block is
        removed.
    """
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        yield temporary
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        elif temporary.exists():
            temporary.unlink()


def sync(path: Path, *, below: bool = True) -> None:
    """Hand a file or a folder to the disk.

    Args:
        path: A file; or a folder, whose names are handed over.
        below: Whether everything in a folder is handed over, too.

    Raises:
        OSError: The disk is full or broken.
    """
    if below and path.is_dir():
        for entry in path.iterdir():
            sync(entry)
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems cannot do it for a folder; they need it least.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Provide a temporary name; what is written there replaces ``path`` unless the block raises.

    Args:
        path: The final name of a file or a folder.
        durable: Whether it has to survive a power cut. That takes milliseconds.

    Raises:
        OSError: ``path`` cannot be replaced, for example because it is a folder with content.
    """
    with temporary_name(path) as temporary:
        yield temporary
        if durable:
            sync(temporary)
        try:
            os.replace(temporary, path)
        except IsADirectoryError:
            said = "A folder lies where a file is to be written; move it away"
            raise IsADirectoryError(errno.EISDIR, said, str(path)) from None
        if durable:
            sync(path.parent, below=False)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Provide a temporary name; the folder made there replaces ``path``, whatever that holds.

    The former folder stays until the new one is complete, and comes back if the new one cannot take
    its name.

    Args:
        path: The final name of the folder, which need not exist.

    Raises:
        OSError: ``path`` cannot be replaced.
    """
    with temporary_name(path) as former, temporary_name(path) as temporary:
        yield temporary
        if path.exists():
            os.replace(path, former)
        try:
            os.replace(temporary, path)
        except BaseException:
            if former.exists():
                os.replace(former, path)
            raise


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write text in UTF-8; see :func:`replacing` for ``durable``."""
    with replacing(path, durable=durable) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any, *, durable: bool = False) -> None:
    """Write a value as JSON; see :func:`replacing` for ``durable``.

    Raises:
        ValueError: It holds numbers that are not finite, see :func:`without_undefined`.
    """
    write_text(path, json.dumps(value, indent=1, allow_nan=False), durable=durable)


def without_undefined(value: Any) -> Any:
    """A JSON value with None in the place of numbers that are not finite: JSON has none of them."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: without_undefined(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_undefined(part) for part in value]
    return value


def read_json(path: Path) -> Any:
    """The value in a JSON file; None if the file is missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
