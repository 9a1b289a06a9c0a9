"""Brings a shared store here for doors that read: whole, or as little as a look takes."""

import json
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

from components.core.integrity import SMALL
from components.core.sealed import RECORD
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

    def look_again(self) -> None:
        """Brings what has changed.

        Raises:
            StoreError: the shared store does not answer.
        """
        for file in (self.root / "progress").glob("*"):
            file.unlink(missing_ok=True)
        super().look_again()
        self.fetch(_nodes(self.root, ()))

    def fetch(self, keys: Iterable[str]) -> None:
        """Brings the records and the small files of finished artifacts.

        Raises:
            StoreError: the shared store does not answer.
        """
        self._begun = None
        missing = {f"nodes/{key}/{RECORD}": key for key in keys if not self.path(key).is_dir()}
        for name, content in self.objects.read_many(list(missing)).items():
            with suppress(ValueError, AttributeError, KeyError, TypeError):
                files = json.loads(content).get("files", {})
                small = [file for file, about in files.items() if about["size"] <= SMALL]
                key = missing[name]
                self._folders.pull_some(key, content, small, self.path(key))


def _nodes(root: Path, sweeps: Collection[str]) -> set[str]:
    names = sweeps or [path.stem for path in sweep_files(root)]
    return {key for name in names for key in known_nodes(root, name)}
