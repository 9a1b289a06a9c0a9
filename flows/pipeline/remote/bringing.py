"""Brings a shared store here for doors that read: whole, or as little as a look takes."""

import json
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

from components.core.integrity import SMALL
from components.core.sealed import RECORD
from flows.pipeline.remote.folders import discard
from flows.pipeline.remote.places import address_of, glance_of
from flows.pipeline.remote.shared_store import SharedStore
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import known_nodes, sweep_files

__all__ = ["Glance", "bring", "glance"]


def bring(folder: Path, sweeps: Collection[str] = ()) -> None:
    """Brings the finished artifacts of sweeps here, if a folder is the copy of a shared store.

    Args:
        folder: Of the store.
        sweeps: Names of the sweeps; all of them by default.

    Raises:
        StoreError: the shared store does not answer.
    """
    url = address_of(folder)
    if url is not None:
        store = SharedStore(url)
        store.look_again()
        store.fetch(_nodes(store.root, sweeps))


def glance(folder: Path) -> ArtifactStore:
    """A store to look at sweeps in; of a shared one, a copy without its large files.

    Raises:
        StoreError: the shared store does not answer.
    """
    url = address_of(folder)
    if url is None:
        return ArtifactStore(folder, create=False)
    store = Glance(url, folder)
    store.look_again()
    return store


class Glance(SharedStore):
    """What is read of a shared store to look at its sweeps; artifacts in it are not whole."""

    def __init__(self, url: str, folder: Path) -> None:
        """Takes the URL and the folder of this machine's copy, whose locks tell of its drivers."""
        root = glance_of(folder)
        root.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            (folder / "locks").mkdir(parents=True, exist_ok=True)
            (root / "locks").symlink_to(folder / "locks")
        super().__init__(url, drives=True, root=root)
        self._seen: set[str] = set()  # keys that this process has compared

    def look_again(self) -> None:
        """Brings what has changed.

        Raises:
            StoreError: the shared store does not answer.
        """
        for file in (self.root / "progress").glob("*"):
            file.unlink(missing_ok=True)
        for folder in ("drivers", "sweeps", "progress"):  # nobody drives in this folder
            self._bring_files(folder)
        self.fetch(_nodes(self.root, ()))

    def fetch(self, keys: Iterable[str]) -> None:
        """Brings the records and the small files of finished artifacts.

        Raises:
            StoreError: the shared store does not answer.
        """
        self._begun = None
        # One that is here may have been made again; every look at all would take too long.
        missing = [key for key in keys if key not in self._seen or not self.path(key).is_dir()]
        records = self.objects.read_many([f"nodes/{key}/{RECORD}" for key in missing])
        for key in missing:
            content = records.get(f"nodes/{key}/{RECORD}")
            if content != self._record_here(key):
                with self._arriving(key):
                    self._show(key, content)
        self._seen |= set(missing)

    def _show(self, key: str, content: bytes | None) -> None:
        if content is None:
            discard(self.path(key))
            return
        with suppress(ValueError, AttributeError, KeyError, TypeError):
            files = json.loads(content).get("files", {})
            small = [file for file, about in files.items() if about["size"] <= SMALL]
            self._folders.pull_some(key, content, small, self.path(key))


def _nodes(root: Path, sweeps: Collection[str]) -> set[str]:
    names = sweeps or [path.stem for path in sweep_files(root)]
    return {key for name in names for key in known_nodes(root, name)}
