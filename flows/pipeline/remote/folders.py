"""Carries folders between a disk and a shared store, so that they appear there whole or not at all.

An artifact, nodes/KEY, has the names of the local store: its files first, then `node.json`, which
holds their digests. Any other folder is a list of digests, NAME.json, and the files by their
digests, NAME/SHA256: written again, it replaces the former one in the instant in which its list
does, and files that both have travel once.
"""

import errno
import json
import os
import secrets
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError, check_files, describe_files
from components.core.sealed import RECORD, check_folder, is_sealed, with_digest
from components.core.sealed import check_digest as take_digest
from flows.pipeline.locks import locked
from flows.pipeline.remote.objects import Objects

__all__ = ["Folder", "Folders", "discard", "discard_abandoned"]

_LOCK = ".lock"
_REMEDY = "give the command again, which makes it anew"
Folder = Mapping[str, Any]
"""The list of a folder: its `files` by name, and whatever its writer adds."""


class Folders:
    """The folders of a shared store."""

    def __init__(self, objects: Objects, scratch: Path) -> None:
        """Takes the store's objects and a folder for half-fetched ones."""
        self._objects, self._scratch = objects, scratch

    def push_artifact(self, folder: Path, key: str) -> None:
        """Copies a finished artifact into the shared store.

        Raises:
            StoreError: it cannot be written.
        """
        names = [name for name in _names_in(folder) if name != RECORD]
        self._objects.upload({f"nodes/{key}/{name}": folder / name for name in names})
        self._objects.write(f"nodes/{key}/{RECORD}", (folder / RECORD).read_bytes())

    def pull_artifact(self, key: str, record: bytes, target: Path) -> None:
        """Copies a finished artifact onto the disk, if it is what was written.

        Args:
            key: Of the node.
            record: Content of its `node.json`.
            target: The folder; what is there stays until all has come.

        Raises:
            DamagedFileError: something is missing or damaged in the shared store.
            StoreError: it does not answer.
        """
        try:
            described = json.loads(record)
        except ValueError:
            described = {}
        # One of an older version has no list.
        if isinstance(described, dict) and is_sealed(described):
            names = list(described["files"])
        else:
            cut = len(f"nodes/{key}/")
            names = [name[cut:] for name in self._objects.sizes(f"nodes/{key}")]
        with self._arriving(target) as half:
            self._bring(key, record, names, half)
            check_folder(half)
            self.replace(half, target)

    def pull_some(self, key: str, record: bytes, names: Collection[str], target: Path) -> None:
        """Copies some files of a finished artifact onto the disk, unchecked; see `pull_artifact`.

        Raises:
            StoreError: the shared store does not answer.
        """
        with self._arriving(target) as half:
            self._bring(key, record, names, half)
            self.replace(half, target)

    def _bring(self, key: str, record: bytes, names: Collection[str], half: Path) -> None:
        (half / RECORD).write_bytes(record)
        wanted = {f"nodes/{key}/{n}": half / _inside(n) for n in names if n != RECORD}
        self._objects.download(wanted)

    @contextmanager
    def _arriving(self, target: Path) -> Iterator[Path]:
        """A folder to fill and to rename; what is left of it at the end is removed."""
        half = self._scratch / f"{target.name}-{secrets.token_hex(6)}"
        target.parent.mkdir(parents=True, exist_ok=True)
        self._scratch.mkdir(parents=True, exist_ok=True)
        with locked(_lock_of(half)):
            half.mkdir()
            try:
                yield half
            finally:
                shutil.rmtree(half, ignore_errors=True)

    def push(
        self,
        folder: Path,
        name: str,
        about: Mapping[str, Any] | None = None,
        leave_out: Collection[str] = (),
    ) -> None:
        """Copies a folder, which others may be writing to, in place of one of the same name.

        Files beside its folders are taken first and arrive last: a checkpoint never lacks the
        snapshots that came before it.

        Args:
            folder: The folder.
            name: In the shared store.
            about: To be told with its list.
            leave_out: Names in it that stay here.

        Raises:
            StoreError: it cannot be written.
            OSError: the folder is being removed.
        """
        with self._arriving(folder) as frozen:
            _link_tree(folder, frozen, leave_out)
            if not folder.is_dir():  # it may have lost files while it was copied
                raise FileNotFoundError(errno.ENOENT, "The folder has been removed", str(folder))
            files = describe_files(frozen)
            stored = self._objects.sizes(name)
            by_digest = {f"{name}/{about['sha256']}": file for file, about in files.items()}
            self._objects.upload(
                {
                    there: frozen / file
                    for there, file in by_digest.items()
                    if stored.get(there) != files[file]["size"]
                }
            )
            content = with_digest({"files": files, **(about or {})})
            self._objects.write(f"{name}.json", json.dumps(content).encode())
            self._objects.delete(stored.keys() - by_digest.keys())

    def list_of(self, content: bytes | None) -> Folder | None:
        """The list of a folder as it was read; None if it is none."""
        try:
            value = json.loads(content or b"")
            take_digest(value)
            return value if isinstance(value["files"], dict) else None
        except (ValueError, KeyError, TypeError, AttributeError):
            return None

    def pull(self, name: str, listed: Folder, target: Path) -> bool:
        """Copies a folder onto the disk, in place of what is there.

        Args:
            name: In the shared store.
            listed: Its list.
            target: The folder.

        Returns:
            Whether it was what its list says; the disk stays as it is otherwise.

        Raises:
            StoreError: the shared store does not answer.
        """
        first: dict[str, str] = {}  # files of the same content travel once
        for file, about in listed["files"].items():
            first.setdefault(f"{name}/{about['sha256']}", _inside(file))
        with self._arriving(target) as half, suppress(DamagedFileError):
            if self._objects.download({there: half / file for there, file in first.items()}):
                for file, about in listed["files"].items():
                    if not (half / _inside(file)).exists():
                        (half / file).parent.mkdir(parents=True, exist_ok=True)
                        shutil.copyfile(half / first[f"{name}/{about['sha256']}"], half / file)
                check_files(half, listed["files"])
                self.replace(half, target)
                return True
        return False

    def replace(self, folder: Path, target: Path) -> None:
        """Renames a folder, in place of what is there: that is never seen in part."""
        gone = self._scratch / f"{target.name}-{secrets.token_hex(6)}"
        gone.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            os.rename(target, gone)
        os.rename(folder, target)
        discard(gone)

    def remove(self, name: str) -> None:
        """Removes a folder; its list first, so that nobody begins to read it.

        Raises:
            StoreError: it cannot be written.
        """
        self._objects.delete([f"{name}.json"])
        self._objects.delete(self._objects.sizes(name))


def discard(path: Path) -> None:
    """Removes a folder or a file, if it is there."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)


def discard_abandoned(scratch: Path) -> None:
    """Removes what killed processes have left of half-fetched folders.

    Args:
        scratch: As given to :class:`Folders`; it need not exist.
    """
    names = {path.name.removesuffix(_LOCK) for path in scratch.glob("*")}
    for half in (scratch / name for name in names):
        with suppress(OSError), locked(_lock_of(half), wait=False) as ours:
            if ours:
                discard(half)


def _lock_of(half: Path) -> Path:
    """The lock of whoever fills a folder."""
    return half.with_name(half.name + _LOCK)


def _names_in(folder: Path) -> list[str]:
    """All files below a folder, relative to it."""
    return sorted(
        (Path(place) / name).relative_to(folder).as_posix()
        for place, _, names in os.walk(folder)
        for name in names
    )


def _inside(name: str) -> str:
    """A name that stays inside its folder.

    Raises:
        DamagedFileError: it does not.
    """
    if name.startswith("/") or ".." in Path(name).parts:
        raise DamagedFileError(f"{name!r} is no name of a file in an artifact", None, _REMEDY)
    return name


def _link_tree(source: Path, target: Path, leave_out: Collection[str]) -> None:
    """A second name for every file, those beside the folders first; later versions replace them."""
    for place, folders, names in os.walk(source):
        if Path(place) == source:
            folders[:] = [name for name in folders if name not in leave_out]
            names = [name for name in names if name not in leave_out]
        folder = target / Path(place).relative_to(source)
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            if name.startswith("."):  # being written
                continue
            try:
                os.link(Path(place) / name, folder / name)
            except OSError:  # a disk without second names, or a file that has just gone
                if (Path(place) / name).exists():
                    shutil.copyfile(Path(place) / name, folder / name)
