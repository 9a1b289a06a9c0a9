"""The report as one HTML page: numbers, figures and scripts inside, no request leaves it."""

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any, Final

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from components.reporting.agreement import agreement_table, correlation_rows, domain_of
from components.reporting.evidence import Evidence
from components.reporting.glossary import GLOSSARY
from components.reporting.overview import Column, Value, shown
from components.reporting.page_data import colours, page_data
from components.reporting.verdicts import verdicts

__all__ = ["PARTS", "page"]

PARTS: Final = (
    ("verdicts", "In plain words"),
    ("results", "Results"),
    ("thesis", "Thesis"),
    ("across", "Over all datasets"),
    ("lambda", "Choosing λ"),
    ("curves", "Training curves"),
    ("ranking", "Logs"),
    ("selection", "Selection"),
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
_LEAST: Final = 0.01  # number that two decimals can show


def page(evidence: Evidence) -> str:
    """The whole page."""
    agreement = agreement_table(evidence)
    tints = colours(evidence.algorithms)
    differences = evidence.differences
    template = Environment(
        loader=PackageLoader("components.reporting", "web"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("page.html.j2")
    return template.render(
        title=f"Offline RL report: {', '.join(evidence.sweeps)}",
        asked=_asked(evidence.sweeps),
        budget=evidence.budget,
        parts=PARTS,
        algorithms=[{"name": name, "colour": tints[name]} for name in evidence.algorithms],
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
        ranking=None if evidence.ranking is None else _table(evidence.ranking),
        selection=None if evidence.selection is None else _table(evidence.selection),
        judges=None if evidence.judges is None else _table(evidence.judges),
        total=_total(evidence.costs),
        costs=_table(evidence.costs),
        software=_table(evidence.software),
        sweeps=evidence.sweeps,
        differences=None if differences.empty else _table(differences),
        changed=len(differences),
        few=len(differences) <= _FEW,
        notes=evidence.notes,
        gaps=evidence.gaps,
        glossary=GLOSSARY,
        style=Markup(_read("page.css")),
        script=Markup(_read("page.js")),
        plotly=Markup(get_plotlyjs()),
        # "<" as an escape, so that no text can end the script element.
        data=Markup(
            json.dumps(page_data(evidence, agreement), allow_nan=False).replace("<", "\\u003c")
        ),
    )


def _read(name: str) -> str:
    return resources.files("components.reporting").joinpath("web", name).read_text("utf-8")


def _script_json(value: Any) -> Markup:
    """JSON inside a script element; "<" is an escape there, so that no text can end the element."""
    return Markup(json.dumps(value, allow_nan=False).replace("<", "\\u003c"))


def _asked(sweeps: Mapping[str, str]) -> str:
    """The sweeps as the door's command line has them."""
    return next(iter(sweeps)) if len(sweeps) == 1 else f"[{','.join(sweeps)}]"


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


def _total(costs: pd.DataFrame) -> str:
    return "" if costs.empty else f"In all {costs['hours'].sum():,.1f} hours of computing."


def _table(table: pd.DataFrame) -> Markup:
    """A table with its columns' names, numbers with few digits; text is escaped."""
    numbers = {name: pd.api.types.is_numeric_dtype(table[name]) for name in table.columns}
    kinds = {name: "" if is_number else ' class="text"' for name, is_number in numbers.items()}
    head = "".join(f"<th{kinds[name]}>{Markup.escape(name)}</th>" for name in table.columns)
    body = "".join(
        "<tr>" + "".join(f"<td{kinds[n]}>{_text(row[n])}</td>" for n in table.columns) + "</tr>"
        for row in table.to_dict("records")
    )
    rows = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return Markup(f'<div class="scroll">{rows}</div>')


def _text(value: Any) -> str:
    if isinstance(value, float):
        if value != value:
            return ""
        return "&lt; 0.01" if 0 < value < _LEAST else f"{value:,.2f}"
    return str(Markup.escape(f"{value:,}" if isinstance(value, int) else value))
