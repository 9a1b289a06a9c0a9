"""The policies that the console offers: those shipped, packed, and of a store, by id.

An id comes from a browser, so it is looked up among what is offered and never joined to a path.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Final

from components.core.integrity import DamagedFileError
from components.operating.operable import SHIPPED, Operable, packed_folders
from flows.pipeline.store import ArtifactStore
from flows.stored_policy import TRAINING, open_operable

__all__ = ["Catalogue", "NotOfferedError", "Offer"]

_KEPT: Final = 4  # opened policies; sessions share them, as nothing of them changes
_LONGEST: Final = 80  # characters of a name that are shown
_LARGEST: Final = {".json": 1_000_000, ".safetensors": 300_000_000}  # bytes of a file that is read
_PACKED: Final = "packed/"  # begins ids, so that no packed one is taken for a shipped one
_TITLES: Final = {"turbine": "Turbine (shipped)", "world": "2-D world (shipped)"}


class NotOfferedError(ValueError):
    """An id that is not among what is offered."""


@dataclass(frozen=True)
class Offer:
    """A policy that can be chosen.

    Attributes:
        id: By which it is asked for: the name of a shipped one, `packed/` and the name of a packed
            one, or the key of a stored one.
        title: What it is called; text of others, to be shown as text alone.
        folder: Of its small files, whose sizes are checked before they are read.
        record: `node.json` of a stored one; None: it is shipped or packed.
    """

    id: str
    title: str
    folder: Path
    record: Mapping[str, Any] | None = None


class Catalogue:
    """What is offered.

    Args:
        store: Folder of the runs; it need not exist.
        packed: Folder of folders that `flows.pack_policy` has made, or one of them.
    """

    def __init__(self, store: Path, packed: Path | None = None) -> None:
        self._store = ArtifactStore(store, create=False)
        self._packed = packed
        self._opened: dict[str, Operable] = {}
        self._lock = Lock()

    def offers(self) -> dict[str, Offer]:
        """All policies by id, shipped ones first; damaged runs are left out."""
        found = {
            name: Offer(name, _TITLES.get(name, _short(name)), folder)
            for name, folder in packed_folders(SHIPPED).items()
        }
        if self._packed is not None:
            for name, folder in packed_folders(self._packed).items():
                found[_PACKED + name] = Offer(_PACKED + name, f"{_short(name)} (packed)", folder)
        stored = [
            Offer(key, _short(record["name"]), self._store.path(key) / "policy", record)
            for key, record in self._records()
        ]
        return found | {o.id: o for o in sorted(stored, key=lambda o: (_rank(o.title), o.title))}

    def open(self, asked: str) -> Operable:
        """Open a policy.

        Args:
            asked: Its id, as a browser sent it.

        Raises:
            NotOfferedError: There is none of this id.
            ValueError: It is damaged, or larger than a policy can be; one sentence.
        """
        offer = self.offers().get(asked)
        if offer is None:
            raise NotOfferedError("There is no such policy.")
        with self._lock:
            if asked not in self._opened:
                _check_sizes(offer.folder)
                try:
                    opened = self._read(offer)
                except (
                    DamagedFileError,
                    KeyError,
                    TypeError,
                    RuntimeError,
                    OverflowError,
                ) as error:
                    raise ValueError(f"{offer.title} cannot be used: {error}") from error
                self._opened[asked] = opened
                while len(self._opened) > _KEPT:
                    del self._opened[next(iter(self._opened))]
            return self._opened[asked]

    def _read(self, offer: Offer) -> Operable:
        if offer.record is None:
            return Operable.load(offer.folder)
        return open_operable(self._store, offer.record)

    def _records(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Keys, being names of folders, and records of stored policies."""
        found: list[tuple[str, Mapping[str, Any]]] = []
        for folder in sorted(self._store.nodes.glob("*")):
            try:
                record = self._store.record(folder.name)
            except (ValueError, OSError):
                continue
            if record["component"] == TRAINING and record["key"] == folder.name:
                found.append((folder.name, record))
        return found


def _short(name: object) -> str:
    """A name as one line of text that is no longer than a line."""
    text = " ".join(str(name).split())
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def _rank(title: str) -> bool:
    return not title.startswith(("lion/", "lambda_td3_bc/", "rvs/"))  # first what can be turned


def _check_sizes(folder: Path) -> None:
    """Refuse files that no policy has, before they are read.

    Raises:
        ValueError: Names the file.
    """
    for path in folder.rglob("*"):
        largest = _LARGEST.get(path.suffix)
        if largest is not None and path.stat().st_size > largest:
            raise ValueError(f"{path} has {path.stat().st_size:,} bytes; no policy is so large.")
