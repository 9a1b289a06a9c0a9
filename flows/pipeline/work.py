"""Work folders: checkpoints and half-made outputs of nodes that are computed together.

An artifact is made in its work folder and renamed into place, so it is there whole or not at all.
When all outputs of a call are ready a marker is written first; a kill between two renames is then
repaired by renaming the rest instead of computing anything again.
"""

import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from components.core.files import read_json, sync, write_json
from components.core.integrity import DamagedFileError
from components.core.sealed import check_folder
from flows.pipeline.artifacts import Artifacts
from flows.pipeline.plan import digest
from flows.pipeline.task import REACHED_FILE

__all__ = ["Work", "WorkFolders"]

_MEMBERS = "members.json"
_READY = "ready.json"
_OUT = "out"
_OURS = (_MEMBERS, _READY, _OUT, REACHED_FILE)


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


class WorkFolders(Artifacts):
    """Finished artifacts and the work folders of unfinished ones."""

    def __init__(self, root: Path | str) -> None:
        """Takes the store's folder; the disk stays as it is."""
        super().__init__(root)
        self.work = self.root / "work"

    def unfinished(self, work: Work) -> frozenset[str]:
        """The keys of a work folder that are not yet published."""
        return frozenset(key for key in work.serves if not self.path(key).is_dir())

    def work_folders(self) -> list[Work]:
        """All readable work folders; other processes may add and remove some meanwhile."""
        found = []
        for folder in sorted(self.work.iterdir()) if self.work.is_dir() else ():
            # Another process may remove its folder between any two of these lines.
            with suppress(FileNotFoundError):
                work = None if folder.name.startswith(".") else _read(folder)
                if work is not None:
                    found.append(work)
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
                found[self.unfinished(work)] = self.reached(work)
        return found

    def reached(self, work: Work) -> float:
        """The fraction that the checkpoint of a work folder holds."""
        reached = read_json(work.path / REACHED_FILE)
        return reached if isinstance(reached, float) else 0.0

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

    def begin_anew(self, work: Work, keys: Sequence[str]) -> Work:
        """Replaces a work folder, of which something is damaged, by an empty one.

        Args:
            work: The folder.
            keys: The nodes to be computed, whose locks are held.
        """
        self._discard(work.path)
        return self._make(keys, None)

    def _make(self, keys: Sequence[str], wider: Work | None) -> Work:
        folder = self.work / digest(sorted(keys), 8)
        # We hold the locks of all keys, so an unfinished folder here belongs to a dead process.
        self._discard(folder)
        beginning = self.work / f".{folder.name}"
        shutil.rmtree(beginning, ignore_errors=True)
        members = tuple(keys)
        if wider is None:
            beginning.mkdir()
        else:
            members = wider.members
            ignore = shutil.ignore_patterns(_MEMBERS, _READY, _OUT)
            shutil.copytree(wider.path, beginning, ignore=ignore)
        whole = {"members": list(members), "serves": list(keys)}
        write_json(beginning / _MEMBERS, whole, durable=True)
        beginning.rename(folder)
        return Work(folder, members, frozenset(keys), wider is not None)

    def fresh_out(self, work: Work, keys: Iterable[str]) -> None:
        """Empties the output folders of nodes about to be computed."""
        (work.path / _READY).unlink(missing_ok=True)
        shutil.rmtree(work.path / _OUT, ignore_errors=True)
        for key in keys:
            work.out(key).mkdir(parents=True)

    def mark_ready(self, work: Work, keys: Sequence[str]) -> None:
        """Marks these outputs as whole, and on the disk; they only have to be renamed."""
        for key in keys:
            sync(work.out(key))
        write_json(work.path / _READY, list(keys))  # without it they are computed again, no more

    def publish_ready(self, work: Work, *, check: bool = True) -> None:
        """Renames what is marked ready, and removes the work folder once all it serves is there.

        Args:
            work: The folder.
            check: Whether outputs are compared with their digests before; a damaged one stays, and
                its node is computed again.
        """
        ready = [key for key in read_json(work.path / _READY) or () if work.out(key).is_dir()]
        for key in ready:
            with suppress(DamagedFileError):
                if check:
                    check_folder(work.out(key))
                self.publish(work.out(key), key)
        if ready:
            sync(self.nodes, below=False)
        if not self.unfinished(work):
            self._discard(work.path)

    def discard(self, work: Work) -> None:
        """Removes a work folder, if it is still there."""
        self._discard(work.path)

    def _discard(self, folder: Path) -> None:
        # Renamed first, so that a kill in the middle leaves no work folder without its checkpoint.
        doomed = self.work / f".gone-{folder.name}"
        shutil.rmtree(doomed, ignore_errors=True)
        with suppress(FileNotFoundError):
            folder.rename(doomed)
            shutil.rmtree(doomed, ignore_errors=True)

    def repair(self) -> list[str]:
        """Finishes the work of killed processes: renames ready outputs, removes useless folders.

        Work that a living process holds is left alone.

        Returns:
            A sentence about every folder that could not be used.
        """
        for work in self.work_folders():
            with self.locked(work.serves, wait=False) as held:
                if held:
                    self.publish_ready(work)
                    if not work.resumed:
                        self._discard(work.path)
        said = []
        for folder in sorted(self.work.glob(".gone-*")):
            shutil.rmtree(folder, ignore_errors=True)
        for folder in self.useless_work():
            self._discard(folder)
            said.append(
                f"{folder} is removed, since its {_MEMBERS} is missing or damaged; "
                "what it was begun for begins anew."
            )
        return said

    def useless_work(self) -> list[Path]:
        """Work folders whose list of members is missing or damaged."""
        folders = sorted(self.work.iterdir()) if self.work.is_dir() else ()
        return [
            folder
            for folder in folders
            if not folder.name.startswith(".")
            # In this order: another process may remove its folder meanwhile.
            if _useless(folder) and folder.is_dir()
        ]


def _useless(folder: Path) -> bool:
    try:
        return _read(folder) is None
    except FileNotFoundError:  # another process has just removed it
        return False


def _read(folder: Path) -> Work | None:
    """A work folder; None if its list of members is not there or not what was written."""
    value = read_json(folder / _MEMBERS)
    try:
        members, serves = tuple(map(str, value["members"])), list(map(str, value["serves"]))
    except (KeyError, TypeError):
        return None
    if folder.name != digest(sorted(serves), 8) or not set(serves) <= set(members):
        return None
    # Hidden ones are half-written files of killed processes.
    names = (entry.name for entry in folder.iterdir())
    begun = any(name not in _OURS and not name.startswith(".") for name in names)
    return Work(folder, members, frozenset(serves), begun)
