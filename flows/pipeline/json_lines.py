"""Files of JSON lines: they only grow, and survive killed writers and full disks."""

import errno
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from components.core.files import without_undefined

__all__ = ["append_line", "mend_last_line", "read_lines"]


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Adds one line, whole or not at all.

    Args:
        path: The file; made if missing. The caller keeps other writers away.
        value: What the line holds; numbers that are not finite become null.

    Raises:
        OSError: The disk is full or cannot be written; the file is as it was.
    """
    text = json.dumps(without_undefined(value), default=str, allow_nan=False)
    line = text.encode() + b"\n"
    with path.open("ab", buffering=0) as file:
        size = file.tell()
        try:
            if file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            with suppress(OSError):
                file.truncate(size)
            raise


def mend_last_line(path: Path) -> None:
    """Removes an incomplete last line, left by a kill, a full disk or a power cut.

    One that lacks only its end is ended. Nothing else is touched.

    Raises:
        ValueError: The file ends in something that no writer of such lines has begun; the message
            names the file and the line.
    """
    if not path.exists():
        return
    with path.open("rb+") as file:
        content = file.read()
        whole = content.rfind(b"\n") + 1
        last = content[whole:]
        if not last:
            return
        if _object(last) is not None:
            file.write(b"\n")
        elif last.startswith(b"{"):
            file.truncate(whole)
        else:
            number = content.count(b"\n") + 1
            raise ValueError(f"line {number} of {path} is no JSON object")


def read_lines(path: Path) -> list[dict[str, Any]]:
    """All lines; none if there is no file. A last line that is still being written is left out.

    Raises:
        ValueError: A line is no JSON object; the message names the file and the line.
    """
    if not path.exists():
        return []
    lines = []
    # Split as written: other signs that end a line may stand in a text.
    *whole, rest = path.read_bytes().split(b"\n")
    for number, text in enumerate([*whole, rest], start=1):
        if not text:
            continue
        value = _object(text)
        if value is None and number > len(whole) and text.startswith(b"{"):
            continue
        if value is None:
            raise ValueError(f"line {number} of {path} is no JSON object")
        lines.append(value)
    return lines


def _object(text: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
