"""The overview as aligned text for a terminal, as Markdown and as LaTeX."""

import math
from collections.abc import Callable
from typing import Final

from components.reporting.overview import Overview, Value, shown
from components.reporting.text_table import TextTable

__all__ = ["latex_overview", "markdown_overview", "text_overview", "text_table"]

_LINES: Final[dict[str, Callable[[Value], str]]] = {
    "  to logged": lambda c: _difference(c) + " " * bool(_difference(c)),
    "  at λ": lambda c: "" if c.proximity is None else f"{c.proximity:.2f} ",
    "  thesis": lambda c: (
        "" if c.thesis is None else shown(c.thesis.value) + (c.thesis.marks or " ")
    ),
}
"""What stands below the values of a dataset, where there is any."""


def text_table(table: Overview) -> TextTable:
    """The words of an overview."""
    labels, rows = _lines(table)
    names = ["logged", *(f"{column.algorithm} " for column in table.columns)]
    return TextTable(names, ["", *(f"{column.place} " for column in table.columns)], labels, rows)


def text_overview(table: Overview, width: int) -> str:
    """Aligned text for a window of `width` characters, see `TextTable.text`."""
    return text_table(table).text(width)


def _lines(table: Overview) -> tuple[list[str], list[list[str]]]:
    """Labels and cells of all lines; those that belong to the dataset above are indented."""
    labels, rows = [], []
    for dataset, level in table.logged.items():
        own = table.row(dataset)
        labels.append(dataset)
        rows.append(["" if level is None else shown(level), *map(_value, own)])
        for label, text in _LINES.items():
            cells = ["", *("" if cell is None else text(cell) for cell in own)]
            if any(cells):
                labels.append(label)
                rows.append(cells)
    return labels, rows


def _difference(cell: Value) -> str:
    known = cell.difference is not None and math.isfinite(cell.difference)
    return shown(cell.difference or 0.0, sign=True) if known else ""


def _value(cell: Value | None) -> str:
    return "" if cell is None else shown(cell.value) + ("*" if cell.best else " ")


def markdown_overview(table: Overview) -> str:
    """A Markdown table: the value (its difference to the logged behaviour), the best bold."""
    heads = ["dataset", "logged", *(column.heading for column in table.columns)]
    lines = [heads, ["---", *["--:"] * (len(heads) - 1)]]
    for dataset, level in table.logged.items():
        own = table.row(dataset)
        lines.append([dataset, "" if level is None else shown(level), *map(_markdown, own)])
        thesis = ["" if cell is None else _LINES["  thesis"](cell).rstrip() for cell in own]
        if any(thesis):
            lines.append(["thesis", "", *thesis])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _markdown(cell: Value | None) -> str:
    if cell is None:
        return ""
    value = f"**{shown(cell.value)}**" if cell.best else shown(cell.value)
    place = "" if cell.proximity is None else f" at {cell.proximity:.2f}"
    difference = _difference(cell)
    return value + place + (f" ({difference})" if difference else "")


def latex_overview(table: Overview) -> str:
    """A LaTeX table (`booktabs`): values with standard errors, best bold, the thesis's below."""
    columns = [f"{_escaped(column.heading)}" for column in table.columns]
    lines = [
        rf"\begin{{tabular}}{{l{'r' * (len(columns) + 1)}}}",
        r"\toprule",
        " & ".join(["dataset", "logged", *columns]) + r" \\",
        r"\midrule",
    ]
    for dataset, level in table.logged.items():
        own = table.row(dataset)
        cells = [_escaped(dataset), "" if level is None else shown(level), *map(_latex, own)]
        lines.append(" & ".join(cells) + r" \\")
        thesis = [
            f"{shown(c.thesis.value)} ({c.thesis.error:.1f})" if c and c.thesis else "" for c in own
        ]
        if any(thesis):
            lines.append(r" & ".join([r"\quad thesis", "", *thesis]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _latex(cell: Value | None) -> str:
    if cell is None:
        return ""
    value = rf"\textbf{{{shown(cell.value)}}}" if cell.best else shown(cell.value)
    error = f" ({cell.standard_error:.1f})" if cell.value == cell.value else ""
    return value + error


def _escaped(text: str) -> str:
    return text.replace("_", r"\_").replace("λ", r"$\lambda$")
