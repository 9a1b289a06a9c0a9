"""The report of policies that were tried, as one HTML page."""

from typing import Any, Final

import pandas as pd

from components.reporting.agreement import agreement_table, correlation_rows, domain_of
from components.reporting.evidence import Evidence
from components.reporting.frame import asked_for, html_table, rendered, total_hours
from components.reporting.glossary import GLOSSARY, JUDGED_TERMS
from components.reporting.judged_page import judged_content, judged_data
from components.reporting.overview import Column, Value, shown
from components.reporting.page_data import page_data
from components.reporting.ranking import ranked_for_people
from components.reporting.verdicts import verdicts

__all__ = ["PARTS", "page"]

_JUDGED: Final[str] = "judged"
PARTS: Final = (
    ("verdicts", "In plain words"),
    ("results", "Results"),
    ("thesis", "Thesis"),
    ("across", "Over all datasets"),
    ("lambda", "Choosing λ"),
    ("curves", "Training curves"),
    ("ranking", "Logs"),
    ("selection", "Selection"),
    (_JUDGED, "Logs without a system"),
    ("costs", "Costs"),
    ("differences", "Repeat it"),
    ("glossary", "Glossary"),
)
"""Ids and short names of the page's parts, in their order."""
_LINES: Final = (
    ("difference", "difference to the log"),
    ("lambda", "where the best λ is"),
    ("thesis", "thesis"),
    ("error", "standard error"),
    ("interval", "95 % interval"),
)
"""Switches of what stands below every value."""
_FEW: Final = 12  # rows that are shown without a click


def page(evidence: Evidence) -> str:
    """The whole page."""
    agreement = agreement_table(evidence)
    differences = evidence.differences
    return rendered(
        "page.html.j2",
        ["page.js", "judged.js"] if evidence.judged else ["page.js"],
        page_data(evidence, agreement) | {"judged": judged_data(evidence.judged)},
        evidence.labels,
        title=f"Offline RL report: {', '.join(evidence.sweeps)}",
        asked=asked_for(evidence.sweeps),
        budget=evidence.budget,
        parts=[(part, name) for part, name in PARTS if evidence.judged or part != _JUDGED],
        judged=judged_content(evidence.judged),
        verdicts=verdicts(evidence),
        logs=evidence.logs,
        lines=_LINES,
        columns=evidence.table.columns,
        domains=_domains(evidence),
        table_notes=evidence.table.signs(),
        correlations=[
            {**row, "spearman": _number(row["spearman"], 2)} for row in correlation_rows(agreement)
        ],
        apart=_apart(agreement),
        across=_across(evidence),
        adapts=any(cell.adapts for cell in evidence.cells.values()),
        adapting=list(dict.fromkeys(c.dataset for c in evidence.cells.values() if c.adapts)),
        finished=list(dict.fromkeys(c.dataset for c in evidence.cells.values())),
        ranking=None
        if evidence.ranking is None
        else html_table(ranked_for_people(evidence.ranking)),
        selection=None if evidence.selection is None else html_table(evidence.selection),
        judges=None if evidence.judges is None else html_table(evidence.judges),
        total=total_hours(evidence.costs),
        costs=html_table(evidence.costs),
        software=html_table(evidence.software),
        sweeps=evidence.sweeps,
        differences=None if differences.empty else html_table(differences),
        changed=len(differences),
        few=len(differences) <= _FEW,
        notes=evidence.notes,
        gaps=evidence.gaps,
        glossary=[*GLOSSARY, *JUDGED_TERMS] if evidence.judged else GLOSSARY,
    )


def _domains(evidence: Evidence) -> list[dict[str, Any]]:
    """The overview, datasets of the thesis's tables 5.3 and 5.4 apart."""
    found: dict[str, list[dict[str, Any]]] = {}
    gaps = {(gap.dataset, gap.algorithm): gap.why for gap in evidence.gaps}
    for dataset, level in evidence.table.logged.items():
        row = zip(evidence.table.columns, evidence.table.row(dataset), strict=True)
        cells = [
            _gap(column, gaps.get((dataset, column.algorithm), "not part of it"))
            if value is None
            else _shown_cell(column, value)
            for column, value in row
        ]
        logged = "" if level is None else shown(level)
        domain = domain_of(evidence.logs[dataset].system)
        rows = found.setdefault(domain[0].upper() + domain[1:], [])
        rows.append({"dataset": dataset, "logged": logged, "cells": cells})
    return [{"name": name, "rows": rows} for name, rows in found.items()]


def _gap(column: Column, why: str) -> dict[str, Any]:
    return {"algorithm": column.algorithm, "value": None, "why": why}


def _shown_cell(column: Column, value: Value) -> dict[str, Any]:
    low, high = value.interval
    surely = ""
    if value.difference is not None:
        level = value.value - value.difference
        surely = "better" if low > level else "worse" if high < level else ""
    known = low == low
    interval = f"{shown(low)} … {shown(high)}" if known else "no interval"
    thesis = ""
    if value.thesis is not None:
        thesis = f"{shown(value.thesis.value)} ({value.thesis.error:g}){value.thesis.marks}"
    return {
        "algorithm": column.algorithm,
        "value": shown(value.value),
        "best": value.best,
        "kind": surely,
        "difference": "" if value.difference is None else shown(value.difference, sign=True),
        "place": "" if value.proximity is None else f"at {value.proximity:.2f}",
        "error": _number(value.standard_error, 1, "± ") if known else "",
        "interval": interval,
        "thesis": thesis,
        "title": f"{column.heading}: {shown(value.value)}, 95 % interval {interval}",
    }


def _number(value: Any, digits: int, before: str = "") -> str:
    return f"{before}{value:.{digits}f}" if value == value else "–"


def _apart(agreement: pd.DataFrame) -> list[dict[str, str]]:
    """Cells that differ from the thesis's by more than both standard errors, the farthest first."""
    if agreement.empty:
        return []
    own = agreement[agreement["apart"]].sort_values("difference", key=abs, ascending=False)
    return [
        {
            "dataset": row["dataset"],
            "algorithm": row["algorithm"],
            "here": f"{row['here']:.1f} ({row['standard error']:.1f})",
            "thesis": f"{row['thesis']:.1f} ({row['its standard error']:.1f})",
            "difference": f"{row['difference']:+.1f}",
        }
        for row in own.to_dict("records")
    ]


def _across(evidence: Evidence) -> dict[str, Any] | None:
    across = evidence.across
    if across is None:
        return None
    ranks, count = across.ranks, len(across.datasets)
    said = f"Over {count} datasets; " if count > 1 else "On one dataset only; "
    if ranks.p_value == ranks.p_value:
        said += f"Friedman's test: p = {ranks.p_value:.2g}. "
    said += f"Mean ranks less than {ranks.critical_difference:.1f} apart (grey) are not told apart."
    return {"datasets": across.datasets, "ranks": said}
