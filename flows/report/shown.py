"""What a command shows of a report or study, as it stands beside it: `reports/SWEEP/shown.json`.

It is as good as the report written anew while all that the report was made from is the same: the
nodes, the code, and what stands in `inputs` besides; and while the files are those that were
written. Whatever cannot be told for certain, such as an artifact without digests, has the report
written again.
"""

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from components.core.cards import CardFormat
from components.core.files import without_undefined, write_json
from components.core.integrity import DamagedFileError, check_files, describe_files
from components.core.sealed import check_digest, record_digest, with_digest
from components.reporting.text_table import TextTable
from flows.pipeline.plan import Plan, digest
from flows.pipeline.store import ArtifactStore

__all__ = ["RANKINGS", "SELECTION", "Shown", "fingerprint", "read_shown", "save_shown"]

SELECTION: Final = "selection.csv"
"""File of the report on judged policies, where there are any."""
RANKINGS: Final = "reports/*/ranking.csv"
"""Files of a store with rankings of logs, of which reports take the first guess of λ."""
_FILE: Final = "shown.json"
_ROOT: Final = Path(__file__).resolve().parents[2]
_CODE: Final = ("components/**/*.py", "components/reporting/**/*.csv", "flows/**/*.py")
_SETTINGS: Final = (
    "conf/**/*.yaml"  # a report compares with the thesis's, which are read from there
)
_LIBRARIES: Final = ("imageio", "matplotlib", "numpy", "pandas", "scipy", "torch")


@dataclass(frozen=True)
class Shown:
    """What is printed and recorded.

    Attributes:
        files: The published files.
        table: The overview; None where there are no rows.
        below: Lines below it.
        headline: Numbers to keep with the sweep: (step, value) pairs by name.
    """

    files: Sequence[Path]
    table: TextTable | None
    below: Sequence[str]
    headline: Mapping[str, Sequence[tuple[int, float]]]

    @property
    def has_page(self) -> bool:
        """Whether there is something that a page can show: policies that were tried or judged."""
        return self.table is not None or any(path.name == SELECTION for path in self.files)

    def lines(self, width: int) -> list[str]:
        """What to print.

        Args:
            width: Of the window in characters.
        """
        return [*(self.table.text(width).splitlines() if self.table else ()), *self.below]


@dataclass(frozen=True)
class _Stored:
    """The file: what is shown, the digest of what it was made from, and all files of the report."""

    inputs: str
    files: Mapping[str, Any]
    published: tuple[str, ...]
    table: Mapping[str, Any] | None
    below: tuple[str, ...]
    headline: Mapping[str, Any]


_VERSION: Final = ("format_version", 1)
_FORMAT: Final = CardFormat(
    kind=_Stored,
    what="record of what is shown",
    remedy="give the sweep's command again to write it",
    version=_VERSION,
    amend=check_digest,
)


def fingerprint(plan: Plan, store: ArtifactStore, *others: str) -> str | None:
    """A digest of everything that a report is made from; None if something carries no digest.

    Args:
        plan: Of the sweep.
        store: With its artifacts.
        others: What else the report says.
    """
    nodes: list[Any] = []
    for node in plan:
        found = None
        if store.complete(node.key):
            found = record_digest(store.record(node.key))
            if found is None:
                return None
        nodes.append([node.key, node.name, node.component, dict(node.tags), found])
    ranked = [[str(path), _sha256(path)] for path in sorted(store.root.glob(RANKINGS))]
    return digest([_code(), list(others), nodes, ranked], 32)


def read_shown(folder: Path, inputs: str) -> Shown | None:
    """What stands beside a report; None unless the report is whole and made from these inputs.

    Args:
        folder: Of the report.
        inputs: The `fingerprint`.
    """
    try:
        stored: _Stored = _FORMAT.read(folder / _FILE)
        if stored.inputs != inputs:
            return None
        check_files(folder, stored.files)
        table = None if stored.table is None else TextTable(**stored.table)
        headline = {
            name: [(step, float("nan") if value is None else value) for step, value in points]
            for name, points in stored.headline.items()
        }
    except (DamagedFileError, TypeError, ValueError):
        return None
    return Shown([folder / name for name in stored.published], table, stored.below, headline)


def save_shown(folder: Path, inputs: str, shown: Shown, others: Sequence[Path]) -> None:
    """Writes it beside a report that is complete.

    Args:
        folder: Of the report.
        inputs: The `fingerprint`.
        shown: What is shown.
        others: Files of the report that are not published.
    """
    published = tuple(path.relative_to(folder).as_posix() for path in shown.files)
    names = {*published, *(path.relative_to(folder).as_posix() for path in others)}
    described = describe_files(folder)
    stored = _Stored(
        inputs,
        {name: described[name] for name in sorted(names)},
        published,
        None if shown.table is None else asdict(shown.table),
        tuple(shown.below),
        without_undefined(shown.headline),
    )
    write_json(folder / _FILE, dict([_VERSION]) | with_digest(asdict(stored)))


def _code() -> str:
    """A digest of what computes and compares: source, settings, Python and libraries."""
    found = hashlib.sha256(sys.version.encode())
    for name in _LIBRARIES:
        found.update(f"{name} {metadata.version(name)}".encode())
    for pattern in (*_CODE, _SETTINGS):
        for path in sorted(_ROOT.glob(pattern)):
            found.update(f"{path.relative_to(_ROOT)} {_sha256(path)}".encode())
    return found.hexdigest()


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
