"""What a computer is and what it has spent, for the records of artifacts."""

import os
import platform
import resource
import sys
from functools import cache

from flows.pipeline.software import processor

__all__ = ["cpu_seconds", "hardware"]


def cpu_seconds() -> float:
    """Processor time of this process and of its ended children."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@cache
def hardware(device: str) -> str:
    """The computer's processors, memory and software in one line, without its name."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        size = f", {memory:.0f} GiB"
    except (OSError, ValueError):
        size = ""
    line = f"{os.cpu_count()} x {processor()}{size}, Python {platform.python_version()}"
    if device == "cuda" and "torch" in sys.modules:
        line += f", {sys.modules['torch'].cuda.get_device_name()}"
    return line
