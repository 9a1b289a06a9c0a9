"""What every page of a report is made of: its frame, scripts, tables; no request leaves a page."""

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, Final

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from components.reporting.page_data import colours

__all__ = ["asked_for", "html_table", "rendered", "total_hours"]

_LEAST: Final = 0.01  # number that two decimals can show


def rendered(
    template: str,
    scripts: Sequence[str],
    data: Mapping[str, Any],
    algorithms: Sequence[str],
    **content: Any,
) -> str:
    """A page: one file of HTML with styles, scripts and numbers inside.

    Args:
        template: Name of the template, which extends the frame.
        scripts: Names of its own scripts, in their order.
        data: What scripts read, JSON-able.
        algorithms: Labels that can be shown and hidden; each has its colour.
        content: What the templates name.
    """
    tints = colours(algorithms)
    environment = Environment(
        loader=PackageLoader("components.reporting", "web"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        algorithms=[{"name": name, "colour": tints[name]} for name in algorithms],
        style=Markup(_read("page.css")),
        scripts=[Markup(_read(name)) for name in ("frame.js", *scripts)],
        plotly=Markup(get_plotlyjs()),
        # "<" as an escape, so that no text can end the script element.
        data=Markup(json.dumps(data, allow_nan=False).replace("<", "\\u003c")),
        **content,
    )


def html_table(table: pd.DataFrame, digits: Mapping[str, int] | None = None) -> Markup:
    """A table with its columns' names; text is escaped.

    Args:
        table: With unique columns.
        digits: Decimals of columns; numbers of the others have two, or are said to be small.
    """
    numbers = {name: pd.api.types.is_numeric_dtype(table[name]) for name in table.columns}
    kinds = {name: "" if is_number else ' class="text"' for name, is_number in numbers.items()}
    decimals = digits or {}
    head = "".join(f"<th{kinds[name]}>{Markup.escape(name)}</th>" for name in table.columns)
    body = "".join(
        "<tr>"
        + "".join(f"<td{kinds[n]}>{_text(row[n], decimals.get(n))}</td>" for n in table.columns)
        + "</tr>"
        for row in table.to_dict("records")
    )
    rows = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return Markup(f'<div class="scroll">{rows}</div>')


def asked_for(sweeps: Mapping[str, str]) -> str:
    """The sweeps as the door's command line has them."""
    return next(iter(sweeps)) if len(sweeps) == 1 else f"[{','.join(sweeps)}]"


def total_hours(costs: pd.DataFrame) -> str:
    """A sentence on what all of it took; empty where nothing is known."""
    return "" if costs.empty else f"In all {costs['hours'].sum():,.1f} hours of computing."


def _read(name: str) -> str:
    return resources.files("components.reporting").joinpath("web", name).read_text("utf-8")


def _text(value: Any, decimals: int | None) -> str:
    if isinstance(value, float):
        if value != value:
            return ""
        if decimals is not None:
            return f"{value:,.{decimals}f}"
        return "&lt; 0.01" if 0 < value < _LEAST else f"{value:,.2f}"
    return str(Markup.escape(f"{value:,}" if isinstance(value, int) else value))
