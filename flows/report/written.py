"""Writes the files of a report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from components.core.files import write_text
from components.reporting.documents import latex_document, markdown_document
from components.reporting.evidence import Evidence
from components.reporting.page import page
from components.reporting.policies import policy_table
from components.reporting.static_figures import static_figures

__all__ = ["Format", "write_files"]

Format = Literal["html", "markdown", "latex"]

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
    text = make(evidence)  # before the folder is touched
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / name, text)
    policies = folder / "policies.parquet"
    policy_table(evidence).to_parquet(policies, index=False)
    files = [folder / name, policies]
    if figures:
        (folder / "figures").mkdir(exist_ok=True)
        for title, figure in static_figures(evidence):
            for ending in ("svg", "pdf"):
                files.append(folder / "figures" / f"{title}.{ending}")
                figure.savefig(files[-1])
    return files
