"""The sweeps of a store and their nodes: STORE/sweeps/NAME.json.

Work that no sweep can continue and artifacts that no sweep reads are found by these records. A
sweep writes its record when it begins, so that what it makes belongs to it from the first moment;
with another plan under the same name the record is replaced.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from components.core.cards import CardFormat
from components.core.files import write_json
from components.core.sealed import check_digest, with_digest

__all__ = ["SweepRecord", "known_nodes", "read_sweep", "sweep_files"]

_VERSION = ("format_version", 1)


@dataclass(frozen=True)
class SweepRecord:
    """A sweep or a search.

    Attributes:
        name: Its name.
        command: How it was begun.
        nodes: Run name by key; of a search, those of the trials asked for so far.
    """

    name: str
    command: str
    nodes: Mapping[str, str]

    def save(self, root: Path) -> None:
        """Writes it into a store.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        path = _folder(root) / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {"name": self.name, "command": self.command, "nodes": dict(self.nodes)}
        write_json(path, dict([_VERSION]) | with_digest(content))


_FORMAT = CardFormat(
    kind=SweepRecord,
    what="record of a sweep",
    remedy="give the sweep's command again to write it",
    version=_VERSION,
    amend=check_digest,
)


def read_sweep(path: Path) -> SweepRecord:
    """Reads one of the `sweep_files`.

    Raises:
        ValueError: The file is damaged or of another version.
    """
    return _FORMAT.read(path)


def known_nodes(root: Path, name: str) -> dict[str, str]:
    """The nodes on the record of a sweep; none if there is no readable one."""
    try:
        return dict(read_sweep(_folder(root) / f"{name}.json").nodes)
    except (FileNotFoundError, ValueError):
        return {}


def sweep_files(root: Path) -> list[Path]:
    """The records of a store."""
    return sorted(path for path in _folder(root).glob("*.json") if not path.name.startswith("."))


def _folder(root: Path) -> Path:
    return root / "sweeps"
