"""What a command shows of its sweep, made again only if it would be another than there is."""

from collections.abc import Callable, Sequence
from pathlib import Path

from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.report.shown import Shown, fingerprint, read_shown, save_shown

__all__ = ["Written", "current", "current_report"]

Written = tuple[Shown, Sequence[Path]]
"""What is shown, and files beside it that are not published."""


def current(
    folder: Path, plan: Plan, store: ArtifactStore, about: str, write: Callable[[], Written]
) -> Shown:
    """Take what is there, or make it.

    Args:
        folder: Of the files.
        plan: Of the sweep.
        store: With its artifacts.
        about: What is made, besides the nodes.
        write: Makes it, from the finished nodes of the plan alone.

    Raises:
        DamagedFileError: A file that it is made of is missing or damaged.
    """
    inputs = fingerprint(plan, store, about)
    found = None if inputs is None else read_shown(folder, inputs)
    if found is not None:
        return found
    shown, others = write()
    # Another driver may have made a node again meanwhile; then nobody knows which one was read.
    if inputs is not None and inputs == fingerprint(plan, store, about):
        save_shown(folder, inputs, shown, others)
    return shown


def current_report(folder: Path, plan: Plan, store: ArtifactStore, about: str = "") -> Shown:
    """The report of a sweep, see `flows.report.report.write_report`.

    Args:
        folder: Made if needed.
        plan: Of the sweep.
        store: With its artifacts.
        about: Profile and seeds, for the titles of figures.

    Raises:
        DamagedFileError: A file that the report is made of is missing or damaged.
    """

    def write() -> Written:
        from flows.report.report import write_report  # figures are slow to import

        written = write_report(folder, plan, store, about)
        return written.shown, [written.nodes] if written.nodes else []

    return current(folder, plan, store, about, write)
