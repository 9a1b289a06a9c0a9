"""Finished artifacts of a shared store: when one counts, how it is mended and how it goes.

The shared store is the truth: what is not there is not finished. It is written only by whoever
holds the node's claim, in an order in which every beginning leaves something whole:

publish     files, `node.json`, then the copy here. Without `node.json` nothing is there.
take away   a copy of `node.json` in damaged/KEY, then `node.json` goes, then the files.
bring       a second folder beside the copy here, compared with its digests, then put in its place.

Where nothing is to be repaired, what is damaged there stays, and `refused` says so.

So a sound copy outlives whatever happens to the shared one, and gives it back. Only one that was
set aside for being stale must not come back: damaged/KEY/stale.json remembers which.
"""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from components.core.integrity import DamagedFileError
from components.core.sealed import RECORD
from flows.pipeline.artifacts import Artifacts
from flows.pipeline.locks import locked
from flows.pipeline.remote.claims import Claims
from flows.pipeline.remote.folders import Folders
from flows.pipeline.remote.objects import Objects
from flows.pipeline.remote.places import copy_of
from flows.pipeline.store import ArtifactStore

__all__ = ["SharedArtifacts"]

_STALE = "stale.json"  # in damaged/KEY: the record of one that was sound, but made from other input
_LOOKS = 3  # at an artifact that somebody replaces while it is brought


class SharedArtifacts(ArtifactStore):
    """The finished artifacts of a shared store, and this machine's copy of them.

    Attributes:
        url: Of the shared store.
        drives: Whether the driver of a sweep holds it, which keeps a copy of all it has computed.
        repairs: Whether what is damaged in the shared store is mended or taken away.
        objects: Of the shared store.
    """

    def __init__(
        self,
        url: str,
        owner: str = "",
        *,
        drives: bool = False,
        repairs: bool = True,
        root: Path | None = None,
    ) -> None:
        """Opens the store, and makes the folder of its copy here.

        Args:
            url: Of the shared store.
            owner: Whose claims are made; empty for a store to read.
            drives: See the class.
            repairs: See the class.
            root: Folder of the copy, if it is another one.

        Raises:
            StoreError: the folder cannot be made, or the protocol is not known.
        """
        super().__init__(root or copy_of(url))
        self.url = url.rstrip("/")
        self.drives, self.repairs = drives, repairs
        self.objects = Objects(self.url)
        self._folders = Folders(self.objects, self.root / "arriving")
        self._claims = Claims(self.objects, owner)
        self._held: set[str] = set()  # keys whose locks this store holds, here and everywhere
        self._mends = bool(owner) and not drives  # a driver does once it gives signs of life
        self._doubtful: set[str] = set()  # keys that wait for that

    def fetch(self, keys: Iterable[str]) -> None:
        """Brings the finished ones of these artifacts here, and mends those of the shared store.

        One that is lost or damaged there comes from a sound copy here; without one it is taken
        away, here and there. Without `repairs`, a damaged one is `refused` and stays.

        Raises:
            StoreError: the shared store does not answer.
        """
        wanted = sorted(set(keys))
        theirs = self.objects.read_many([_record(key) for key in wanted])
        for key in wanted:
            with self._arriving(key):
                here, content = self._bring(key, theirs.get(_record(key)))
                self.refused.pop(key, None)
                if not here and content is not None and not self.repairs:
                    where = f"nodes/{key} of {self.url}"
                    self.refused[key] = f"{where} cannot be used: it is not what was written"
                elif not here and self._claims.owner:
                    self._mend(key, content)

    def publish(self, folder: Path, key: str) -> None:
        """Makes a filled folder the artifact of a node, everywhere; the first publisher wins.

        Who does not hold the node's lock leaves the folder to those who do, if there are any.

        Raises:
            StoreError: the shared store does not answer or cannot be written.
        """
        with self._alone(key) as alone, self._arriving(key):
            if not alone:
                return
            here, content = self._bring(key, self.objects.read(_record(key)))
            if here:
                shutil.rmtree(folder)
                return
            if content is not None:
                self._take_away(key, content)
            self._folders.push_artifact(folder, key)
            self._folders.replace(folder, self.path(key))

    def set_aside(self, key: str, place: int | None) -> bool:
        """Moves what is not what was written out of the way, see :meth:`Artifacts.set_aside`.

        One that is sound but made from another input goes everywhere; where only the copy here is
        damaged, the shared one stays and comes back when it is needed.
        """
        judged = self._sound_record(key)
        moved = super().set_aside(key, place)
        if moved and judged is not None:
            self._take_away(key, judged, _STALE)
        return moved

    @contextmanager
    def locked(self, keys: Iterable[str], *, wait: bool = True) -> Iterator[bool]:
        """Holds the locks of several nodes, here and, for drivers and workers, everywhere."""
        wanted = set(keys)
        with super().locked(wanted, wait=wait) as held:
            if not held or not self._claims.owner:
                yield held
                return
            with self._claims.held(wanted, wait=wait) as claimed:
                self._held |= wanted if claimed else set()
                try:
                    yield claimed
                finally:
                    self._held -= wanted

    def _bring(self, key: str, content: bytes | None) -> tuple[bool, bytes | None]:
        """Makes the copy here the shared artifact, if that is sound; else it stays as it is.

        Args:
            key: Of the node.
            content: The shared `node.json`, as it was read before; None without one.

        Returns:
            Whether the copy here is the shared artifact now; and the `node.json` judged last.

        Raises:
            StoreError: the shared store does not answer.
        """
        judged = content
        for _ in range(_LOOKS):
            if content is None:
                return False, None
            # A worker reads its inputs whole in any case, and each file is hashed once.
            large = bool(self._claims.owner) and not self.drives
            if self._record_here(key) == content and self.intact(key, large=large):
                return True, content
            self._records.pop(key, None)
            with suppress(DamagedFileError):
                self._folders.pull_artifact(key, content, self.path(key))
                return True, content
            judged, content = content, self.objects.read(_record(key))
            if content == judged:
                break
        return False, judged

    def _mend(self, key: str, content: bytes | None) -> None:
        """Does what can be done about an artifact that cannot be brought.

        Args:
            key: Of the node.
            content: The `node.json` of a damaged one; None where the shared store has none.
        """
        ours = self._sound_record(key)
        if ours is not None and self.objects.read(f"damaged/{key}/{_STALE}") == ours:
            ours = None
        if ours is None and self.repairs:
            Artifacts.set_aside(self, key, self.place(key))
        if ours is None and content is None:
            return
        if not self._mends:
            self._doubtful.add(key)
            return
        with self._alone(key) as alone:
            if not alone or self.objects.read(_record(key)) != content:
                return  # somebody is mending it
            if content is not None:
                self._take_away(key, content)
            if ours is not None:
                self._folders.push_artifact(self.path(key), key)

    def _take_away(self, key: str, judged: bytes, name: str = RECORD) -> None:
        """Removes an artifact from the shared store, if it is still the one that was judged.

        Args:
            key: Of the node, whose lock is held.
            judged: Its `node.json`.
            name: Of the copy of that in damaged/KEY.
        """
        if self.objects.read(_record(key)) == judged:
            self.objects.write(f"damaged/{key}/{name}", judged)
            self.objects.delete([_record(key)])  # first: what has lost a file must not count
            self.objects.delete(self.objects.sizes(f"nodes/{key}"))

    def _record_here(self, key: str) -> bytes | None:
        with suppress(OSError):
            return (self.path(key) / RECORD).read_bytes()
        return None

    def _sound_record(self, key: str) -> bytes | None:
        """The `node.json` of the copy here, if that is what was written to the last byte."""
        with suppress(DamagedFileError):
            self.check(key, fresh=True)
            return self._record_here(key)
        return None

    @contextmanager
    def _alone(self, key: str) -> Iterator[bool]:
        """Whether nobody else may write a node's artifact within this block."""
        if key in self._held:
            yield True
            return
        with self._claims.alone(key) as alone:
            yield alone

    @contextmanager
    def _arriving(self, key: str) -> Iterator[None]:
        """Keeps other processes of this machine from changing the same copy."""
        with locked(self.locks / f"arriving-{key}"):
            yield


def _record(key: str) -> str:
    return f"nodes/{key}/{RECORD}"
