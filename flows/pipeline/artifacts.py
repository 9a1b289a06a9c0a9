"""Finished artifacts: one folder per node, complete if and only if it is there, and sealed.

A folder that is not what was written is never repaired in place. It is set aside, into
ROOT/damaged/KEY, and its node is unfinished again.
"""

import errno
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError, describe_files
from components.core.sealed import (
    RECORD,
    REMEDY,
    check_folder,
    content_digest,
    is_sealed,
    manifest_digest,
    read_record,
    read_sealed_json,
)
from flows.pipeline.locks import locked

__all__ = ["Artifacts"]

_FIELDS = ("key", "name", "component", "inputs", "started", "finished", "seconds")


class Artifacts:
    """Finished artifacts by key."""

    def __init__(self, root: Path | str) -> None:
        """Takes the store's folder; the disk stays as it is."""
        self.root = Path(root).absolute()
        self.nodes = self.root / "nodes"
        self.damaged = self.root / "damaged"
        self.locks = self.root / "locks"
        self._records: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {}

    def path(self, key: str) -> Path:
        """Folder of a finished artifact."""
        return self.nodes / key

    def key_of(self, path: Path) -> str | None:
        """The key of the artifact that holds a file; None if the file is elsewhere."""
        return path.relative_to(self.nodes).parts[0] if self.nodes in path.parents else None

    def place(self, key: str) -> int | None:
        """Inode of what is there, finished artifact or not; None if nothing is."""
        try:
            return self.path(key).stat().st_ino
        except OSError:
            return None

    def record(self, key: str) -> dict[str, Any]:
        """The content of a finished node's `node.json`, which is the caller's to read only.

        Raises:
            DamagedFileError: it is missing or not what was written.
        """
        path = self.path(key) / RECORD
        with suppress(OSError):
            status = path.stat()
            identity = (status.st_ino, status.st_size, status.st_mtime_ns)
            known = self._records.get(key)
            if known is None or known[0] != identity:
                self._records[key] = known = (identity, self._read(key))
            return known[1]
        return self._read(key)

    def _read(self, key: str) -> dict[str, Any]:
        folder = self.path(key)
        if folder.exists() and not folder.is_dir():
            raise DamagedFileError(f"{folder} is a file and should be a folder", folder, REMEDY)
        record = read_record(folder)
        missing = [name for name in _FIELDS if name not in record]
        path = folder / RECORD
        if missing:
            raise DamagedFileError(f"{path} lacks {', '.join(missing)}", path, REMEDY)
        if record["key"] != key:
            raise DamagedFileError(f"{path} is that of {record['key']}", path, REMEDY)
        return record

    def records(self) -> Iterator[dict[str, Any]]:
        """The readable `node.json` of the finished nodes of all sweeps."""
        for folder in sorted(self.nodes.iterdir()) if self.nodes.is_dir() else ():
            with suppress(DamagedFileError):
                yield self.record(folder.name)

    def complete(self, key: str) -> bool:
        """Whether a node is finished: its folder is there, with a sound `node.json`."""
        try:
            return bool(self.record(key))
        except DamagedFileError:
            return False

    def check(
        self,
        key: str,
        names: Collection[str] | None = None,
        *,
        large: bool = True,
        fresh: bool = False,
    ) -> dict[str, Any]:
        """Compares the files of a finished artifact with their digests.

        Args:
            key: Of the node.
            names: The files to check; all by default.
            large: Whether large files are hashed, too; otherwise only their sizes are compared.
            fresh: Whether large files are hashed even if this process has done so before.

        Returns:
            Its `node.json`.

        Raises:
            DamagedFileError: something is missing or damaged.
        """
        record = self.record(key)
        check_folder(self.path(key), names, record=record, large=large, fresh=fresh)
        return record

    def intact(self, key: str, *, large: bool = False) -> bool:
        """Whether a node is finished and its files are what was written, see :meth:`check`."""
        try:
            return bool(self.check(key, large=large))
        except DamagedFileError:
            return False

    def content(self, key: str) -> str:
        """A digest of all files of a finished artifact but its `node.json`.

        Raises:
            DamagedFileError: its `node.json` is missing or damaged.
        """
        record = self.record(key)
        if is_sealed(record):
            return str(content_digest(record))
        return manifest_digest(describe_files(self.path(key), leave_out=(RECORD,)))

    def read_json(self, key: str, name: str) -> Any:
        """The value in a JSON file of a finished artifact.

        Raises:
            DamagedFileError: it is missing or damaged.
        """
        return read_sealed_json(self.path(key), name)

    def publish(self, folder: Path, key: str) -> None:
        """Makes a filled folder the artifact of a node; the first of two publishers wins."""
        try:
            folder.rename(self.path(key))
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
            shutil.rmtree(folder)

    def set_aside(self, key: str, place: int | None) -> bool:
        """Moves what is not what was written out of the way; the caller holds the node's lock.

        Args:
            key: Of the node.
            place: What :meth:`place` returned when it was judged.

        Returns:
            Whether it was still there.
        """
        if place is None or self.place(key) != place:
            return False
        aside = self.damaged / key
        if aside.is_dir():
            shutil.rmtree(aside)
        aside.unlink(missing_ok=True)
        self.damaged.mkdir(exist_ok=True)
        self.path(key).rename(aside)
        return True

    @contextmanager
    def locked(self, keys: Iterable[str], *, wait: bool = True) -> Iterator[bool]:
        """Holds the locks of several nodes, always taken in one order to avoid deadlocks.

        Yields:
            Whether all locks are held.
        """
        with ExitStack() as stack:
            yield all(
                # `all` stops at a lock that another process holds; leaving gives back the others.
                stack.enter_context(locked(self.locks / key, wait=wait))
                for key in sorted(set(keys))
            )
