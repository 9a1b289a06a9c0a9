"""Files of JSON lines: they only grow, and survive killed writers and full disks."""

import errno
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from components.core.files import without_undefined

__all__ = ["append_line", "read_lines", "remove_partial_line"]


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


def remove_partial_line(path: Path) -> None:
    """Removes an incomplete last line, left by a kill, a full disk or a power cut."""
    if not path.exists():
        return
    with path.open("rb+") as file:
        content = file.read()
        if content and not content.endswith(b"\n"):
            file.truncate(content.rfind(b"\n") + 1)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """All lines; none if there is no file.

    Raises:
        ValueError: A line is no JSON object; the message names the file and the line.
    """
    if not path.exists():
        return []
    lines = []
    for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            value = json.loads(text)
        except ValueError:
            value = None
        if not isinstance(value, dict):
            raise ValueError(f"line {number} of {path} is no JSON object")
        lines.append(value)
    return lines
