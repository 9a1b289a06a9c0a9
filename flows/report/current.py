"""The report of a sweep, written only if it would be another one than there is."""

from pathlib import Path

from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.report.shown import Shown, fingerprint, read_shown, save_shown

__all__ = ["current_report"]


def current_report(folder: Path, plan: Plan, store: ArtifactStore, about: str = "") -> Shown:
    """Take the report that is there, or write it, see `flows.report.report.write_report`.

    Args:
        folder: Made if needed.
        plan: Of the sweep.
        store: With its artifacts.
        about: Profile and seeds, for the titles of figures.

    Raises:
        DamagedFileError: A file that the report is made of is missing or damaged.
    """
    inputs = fingerprint(plan, store, about)
    found = None if inputs is None else read_shown(folder, inputs)
    if found is not None:
        return found
    from flows.report.report import write_report  # figures are slow to import

    written = write_report(folder, plan, store, about)
    # Another driver may have made a node again meanwhile; then nobody knows which one was read.
    if inputs is not None and written.nodes and inputs == fingerprint(plan, store, about):
        save_shown(folder, inputs, written.shown, [written.nodes])
    return written.shown
