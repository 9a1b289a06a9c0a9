"""The version of this package, which artifacts and checkpoints name."""

from functools import cache
from importlib import metadata

__all__ = ["code_version"]


@cache
def code_version() -> str:
    """Version of this package, or "unknown" where it runs without being installed."""
    try:
        return metadata.version("proximity-bench")
    except metadata.PackageNotFoundError:
        return "unknown"
