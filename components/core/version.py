"""The version of this package, which artifacts and checkpoints name."""

import os
from functools import cache
from importlib import metadata
from typing import Final

__all__ = ["TRAVELLING", "code_version"]

TRAVELLING: Final = "PROXIMITY_BENCH_VERSION"
"""Environment variable: the version of code that has come to a machine without its metadata."""


@cache
def code_version() -> str:
    """Version of this package, or "unknown" where it runs without being installed."""
    try:
        return os.environ.get(TRAVELLING) or metadata.version("proximity-bench")
    except metadata.PackageNotFoundError:
        return "unknown"
