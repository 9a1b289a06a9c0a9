"""Writes the files of a report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pandas as pd

from components.core.files import write_text
from components.reporting.documents import judged_document, latex_document, markdown_document
from components.reporting.evidence import Evidence
from components.reporting.judged import Judged
from components.reporting.judged_page import judged_page
from components.reporting.page import page
from components.reporting.policies import policy_table
from components.reporting.static_figures import static_figures

__all__ = ["Format", "write_files", "write_judged"]

Format = Literal["html", "markdown", "latex"]

_JUDGED_FILES = {
    "html": ("report.html", judged_page),
    "markdown": ("report.md", judged_document),
}
_FILES = {
    "html": ("report.html", page),
    "markdown": ("report.md", markdown_document),
    "latex": ("report.tex", latex_document),
}


def write_files(
    folder: Path, evidence: Evidence, kind: Format, *, figures: bool = False
) -> Sequence[Path]:
    """Write a report and the returns of its policies.

    Args:
        folder: Made if needed.
        evidence: What it shows.
        kind: Of the document.
        figures: Whether all figures are written as SVG and PDF, too, into `figures/`.

    Returns:
        The files.
    """
    name, make = _FILES[kind]
    files = _written(folder, name, make(evidence), policy_table(evidence))
    if len(evidence.judged_policies):
        files.append(folder / "judged.parquet")
        evidence.judged_policies.to_parquet(files[-1], index=False)
    if figures:
        (folder / "figures").mkdir(exist_ok=True)
        for title, figure in static_figures(evidence):
            for ending in ("svg", "pdf"):
                files.append(folder / "figures" / f"{title}.{ending}")
                figure.savefig(files[-1])
    return files


def write_judged(folder: Path, judged: Judged, kind: Literal["html", "markdown"]) -> Sequence[Path]:
    """Write a report on policies that were judged and never tried, and all judgements.

    Args:
        folder: Made if needed.
        judged: What it shows.
        kind: Of the document.

    Returns:
        The files.
    """
    name, make = _JUDGED_FILES[kind]
    return _written(folder, name, make(judged), judged.policies)


def _written(folder: Path, name: str, text: str, policies: pd.DataFrame) -> list[Path]:
    """The document and the table of policies; both were made before the folder is touched."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name, folder / "policies.parquet"]
    write_text(files[0], text)
    policies.to_parquet(files[1], index=False)
    return files
