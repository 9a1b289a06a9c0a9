"""The artifact store: finished artifacts and unfinished work on disk.

    ROOT/nodes/KEY/     a finished artifact: complete if and only if the folder is there
    ROOT/work/GROUP/    checkpoints and half-made outputs of nodes that are computed together
    ROOT/progress/      progress reports of running calls, and requests to stop them
    ROOT/locks/         one lock per node that is being computed

An artifact is made in its work folder and renamed into place, so it is there whole or not at all.
When all outputs of a call are ready a marker is written first; a kill between two renames is then
repaired by renaming the rest instead of computing anything again.
"""

import errno
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from components.core.files import read_json, write_json
from flows.pipeline.errors import StoreError
from flows.pipeline.locks import locked
from flows.pipeline.plan import digest
from flows.pipeline.task import REACHED_FILE

__all__ = ["ArtifactStore", "Work", "disk_error_message"]

_MEMBERS = "members.json"
_READY = "ready.json"
_OUT = "out"
_OURS = (_MEMBERS, _READY, _OUT, REACHED_FILE)


def disk_error_message(error: BaseException, root: Path) -> str | None:
    """One sentence with the remedy if an error is about the disk, else None."""
    if not isinstance(error, OSError):
        return None
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"The disk that holds {root} is full: free space and give the same command again."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST):
        return (
            f"The folder {root} cannot be written ({error.strerror}): "
            "make it a writable folder or choose another one."
        )
    return None


@dataclass(frozen=True)
class Work:
    """The folder in which a set of nodes is computed together.

    Attributes:
        path: The folder.
        members: Keys in the order of the checkpoint.
        serves: The keys whose artifacts are made here.
        resumed: Whether an earlier call left a checkpoint in it.
    """

    path: Path
    members: tuple[str, ...]
    serves: frozenset[str]
    resumed: bool = False

    def out(self, key: str) -> Path:
        """Folder in which the artifact of a node is made."""
        return self.path / _OUT / key


class ArtifactStore:
    """Finished artifacts by key, and the work folders of unfinished ones."""

    def __init__(self, root: Path | str, *, create: bool = True) -> None:
        """Opens a store.

        Args:
            root: Its folder.
            create: Whether to make the folders; False leaves the disk as it is.

        Raises:
            StoreError: the folder cannot be made or written.
        """
        self.root = Path(root).absolute()
        self.nodes = self.root / "nodes"
        self.work = self.root / "work"
        self.locks = self.root / "locks"
        self._progress = self.root / "progress"
        if create:
            try:
                for folder in (self.nodes, self.work, self.locks, self._progress):
                    folder.mkdir(parents=True, exist_ok=True)
                probe = self.locks / f".probe-{os.getpid()}"
                try:
                    probe.write_text("a few bytes, to find a full disk before the work starts\n")
                finally:
                    probe.unlink(missing_ok=True)
            except OSError as error:
                sentence = disk_error_message(error, self.root)
                raise StoreError(sentence or f"{self.root} cannot be used: {error}.") from error

    # Finished artifacts

    def path(self, key: str) -> Path:
        """Folder of a finished artifact."""
        return self.nodes / key

    def complete(self, key: str) -> bool:
        """Whether a node is finished.

        Raises:
            StoreError: its folder is there but damaged.
        """
        if not self.path(key).is_dir():
            return False
        self.record(key)
        return True

    def record(self, key: str) -> dict[str, Any]:
        """The content of a finished node's `node.json`.

        Raises:
            StoreError: the artifact is damaged.
        """
        record = read_json(self.path(key) / "node.json")
        if not isinstance(record, dict) or record.get("key") != key:
            raise StoreError(
                f"The artifact {self.path(key)} is damaged (its node.json is missing or broken): "
                "delete that folder and give the same command again."
            )
        return record

    def records(self) -> Iterator[dict[str, Any]]:
        """The readable `node.json` of the finished nodes of all sweeps."""
        if not self.nodes.is_dir():
            return
        for folder in sorted(self.nodes.iterdir()):
            record = read_json(folder / "node.json")
            if isinstance(record, dict):
                yield record

    def publish(self, folder: Path, key: str) -> None:
        """Makes a filled folder the artifact of a node; the first of two publishers wins."""
        try:
            folder.rename(self.path(key))
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
            shutil.rmtree(folder)

    # Unfinished work

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

    def unfinished(self, work: Work) -> frozenset[str]:
        """The keys of a work folder that are not yet published."""
        return frozenset(key for key in work.serves if not self.path(key).is_dir())

    def work_folders(self) -> list[Work]:
        """All readable work folders; other processes may add and remove some meanwhile."""
        found = []
        for folder in sorted(self.work.iterdir()) if self.work.is_dir() else ():
            members = None if folder.name.startswith(".") else read_json(folder / _MEMBERS)
            # Another process may remove its folder between any two of these lines.
            with suppress(FileNotFoundError):
                if not isinstance(members, dict):
                    continue
                # Hidden ones are half-written files of killed processes.
                names = (entry.name for entry in folder.iterdir())
                begun = any(name not in _OURS and not name.startswith(".") for name in names)
                found.append(
                    Work(folder, tuple(members["members"]), frozenset(members["serves"]), begun)
                )
        return found

    def split(self, keys: Sequence[str]) -> list[list[str]]:
        """Divides pending nodes that may be computed together by the work already begun on them.

        A sweep with more seeds than the one before continues the old seeds from their checkpoint
        and starts the new ones beside them.

        Args:
            keys: Pending keys of one lane group.

        Returns:
            Groups of keys, each in the given order.
        """
        rest = set(keys)
        groups = []
        for work in sorted(self.work_folders(), key=lambda w: (-len(w.serves), w.path.name)):
            unfinished = self.unfinished(work)
            if unfinished and unfinished <= rest:
                groups.append([key for key in keys if key in unfinished])
                rest -= unfinished
        if rest:
            groups.append([key for key in keys if key in rest])
        return groups

    def begun(self) -> dict[frozenset[str], float]:
        """By their keys, the fraction that the checkpoint of nodes computed together holds."""
        found = {}
        for work in self.work_folders():
            if work.resumed:
                reached = read_json(work.path / REACHED_FILE)
                found[self.unfinished(work)] = reached if isinstance(reached, float) else 0.0
        return found

    def open_work(self, keys: Sequence[str]) -> Work:
        """Finds or makes the work folder for unfinished nodes whose locks are held.

        Args:
            keys: The nodes to be computed now, all of them unpublished.

        Returns:
            The folder begun for exactly these nodes (others of its members may be published), else
            a copy of one that was begun for more of them, else a new one.
        """
        wanted = frozenset(keys)
        works = self.work_folders()
        for work in works:
            if self.unfinished(work) == wanted:
                return work
        wider = next((work for work in works if self.unfinished(work) > wanted), None)
        return self._make(keys, wider)

    def _make(self, keys: Sequence[str], wider: Work | None) -> Work:
        folder = self.work / digest(sorted(keys), 8)
        # We hold the locks of all keys, so an unfinished folder here belongs to a dead process.
        shutil.rmtree(folder, ignore_errors=True)
        beginning = self.work / f".{folder.name}"
        shutil.rmtree(beginning, ignore_errors=True)
        members = tuple(keys)
        if wider is None:
            beginning.mkdir()
        else:
            members = wider.members
            ignore = shutil.ignore_patterns(_MEMBERS, _READY, _OUT)
            shutil.copytree(wider.path, beginning, ignore=ignore)
        write_json(beginning / _MEMBERS, {"members": list(members), "serves": list(keys)})
        beginning.rename(folder)
        return Work(folder, members, frozenset(keys), wider is not None)

    def fresh_out(self, work: Work, keys: Iterable[str]) -> None:
        """Empties the output folders of nodes about to be computed."""
        (work.path / _READY).unlink(missing_ok=True)
        shutil.rmtree(work.path / _OUT, ignore_errors=True)
        for key in keys:
            work.out(key).mkdir(parents=True)

    def mark_ready(self, work: Work, keys: Sequence[str]) -> None:
        """Marks these outputs as whole; they only have to be renamed."""
        write_json(work.path / _READY, list(keys))

    def publish_ready(self, work: Work) -> None:
        """Renames what is marked ready, and removes the work folder once all it serves is there."""
        for key in read_json(work.path / _READY) or ():
            if work.out(key).is_dir():
                self.publish(work.out(key), key)
        if not self.unfinished(work):
            self.discard(work)

    def discard(self, work: Work) -> None:
        """Removes a work folder."""
        # Renamed first, so that a kill in the middle leaves no work folder without its checkpoint.
        doomed = self.work / f".gone-{work.path.name}"
        shutil.rmtree(doomed, ignore_errors=True)
        with suppress(FileNotFoundError):
            work.path.rename(doomed)
            shutil.rmtree(doomed, ignore_errors=True)

    def repair(self) -> None:
        """Finishes the work of killed processes: renames ready outputs, removes useless folders.

        Work that a living process holds is left alone.
        """
        for work in self.work_folders():
            with self.locked(work.serves, wait=False) as held:
                if held:
                    self.publish_ready(work)
                    if not work.resumed:
                        self.discard(work)
        for folder in self.work.iterdir():
            if folder.name.startswith(".gone-"):
                shutil.rmtree(folder, ignore_errors=True)

    # Progress

    def progress_file(self, group: str) -> Path:
        """The file in which a running call reports its progress."""
        return self._progress / f"{group}.json"

    def stop_file(self, group: str) -> Path:
        """The file that asks a running call to stop, once it exists."""
        return self._progress / f"{group}.stop"

    def clear_progress(self, group: str) -> None:
        """Removes a call's report and stop request, also a half-written report of a killed call."""
        for half in self._progress.glob(f".{group}.json-*"):
            half.unlink(missing_ok=True)
        self.progress_file(group).unlink(missing_ok=True)
        self.stop_file(group).unlink(missing_ok=True)

    def losses(self, group: str) -> list[tuple[float, float]]:
        """Held-out losses that a call has reported, each after its fraction of the budget."""
        value = read_json(self.progress_file(group))
        losses = value.get("losses", ()) if isinstance(value, dict) else ()
        return [(float(fraction), float(loss)) for fraction, loss in losses]

    def fraction(self, group: str) -> float | None:
        """The fraction of a call that is done, between 0 and 1; None if it has not begun."""
        value = read_json(self.progress_file(group))
        return float(value["fraction"]) if isinstance(value, dict) else None
