"""Where a machine keeps its copy of a store that a URL names.

The folder's name is the URL, quoted, so that one leads to the other and nothing has to be recorded.
"""

import os
import re
from pathlib import Path
from urllib.parse import quote, unquote

__all__ = ["CACHE", "address_of", "cache_folder", "copy_of", "glance_of", "is_address"]

CACHE = "PROXIMITY_BENCH_CACHE"
"""Environment variable: the folder for copies of shared stores, on a disk of this machine."""

_COPIES, _GLANCES = "stores", "glances"
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_LONGEST = 240  # bytes of a folder's name, with room for temporary ones
_PASSWORD = re.compile(r"://[^/]*:[^/]*@")


def is_address(store: str) -> bool:
    """Whether a store is named by a URL and not by a folder."""
    return _ADDRESS.match(store) is not None


def cache_folder() -> Path:
    """The folder for copies of shared stores."""
    if named := os.environ.get(CACHE):
        return Path(named).expanduser().absolute()
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser().absolute() / "proximity-bench"


def copy_of(url: str) -> Path:
    """The folder of this machine's copy of a store.

    Raises:
        ValueError: the URL holds a password or is too long.
    """
    return cache_folder() / _COPIES / _name(url)


def glance_of(folder: Path) -> Path:
    """Beside the copy of a store, the folder for what is read of it to look at a sweep."""
    return folder.parents[1] / _GLANCES / folder.name


def address_of(folder: Path) -> str | None:
    """The URL of the store that a folder is a copy of; None for a folder of its own."""
    if folder.absolute().parent.parent != cache_folder():
        return None
    url = unquote(folder.name)
    return url if folder.parent.name in (_COPIES, _GLANCES) and is_address(url) else None


def _name(url: str) -> str:
    if _PASSWORD.search(url):
        raise ValueError(
            "store=URL may not hold a password; put credentials into the environment, see "
            "docs/cluster.md."
        )
    name = quote(url.rstrip("/"), safe="")
    if len(name) > _LONGEST:
        raise ValueError(f"store={url} is too long; choose a shorter prefix.")
    return name
