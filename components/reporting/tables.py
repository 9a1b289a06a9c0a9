"""The result table: one row per dataset, algorithm and proximity, beside the thesis's numbers.

A statistic that is not a number (a policy diverged) reads ``nan`` in the CSV file. An empty cell
means that there is no such number: the policy takes no proximity, or the thesis has no result, or
none that is counted likewise. No column has both, so NaN has one meaning in each column.
"""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import pandas as pd

from components.reporting.thesis_numbers import Thesis

__all__ = [
    "COLUMNS",
    "ended_notes",
    "markdown_table",
    "read_results",
    "result_table",
    "results_csv",
    "undefined_notes",
    "with_undefined",
]

_STATISTICS: Final = ("tenth_percentile", "standard_error", "mean", "std", "iqm")
_INTERVAL: Final = ("interval_low", "interval_high")
_TYPES: Final = {
    "dataset": "object",
    "algorithm": "object",
    "proximity": "float64",
    "seeds": "int64",
    "policies": "int64",
    **dict.fromkeys(_STATISTICS, "float64"),
    "thesis_tenth_percentile": "float64",
    "thesis_standard_error": "float64",
    **dict.fromkeys(_INTERVAL, "float64"),
}
COLUMNS: Final = tuple(_TYPES)
_FORMER_NAMES: Final = {"lambda": "proximity"}
"""Columns that had another name in older files; in summaries they still have it."""
_FORMER: Final = COLUMNS[: -len(_INTERVAL)]
"""Columns of older files, which have no intervals."""


def result_table(
    summaries: Iterable[Mapping[str, Any]],
    thesis: Mapping[tuple[str, str], Thesis] = MappingProxyType({}),
) -> pd.DataFrame:
    """One row per point of every summary, with all ``COLUMNS``.

    Args:
        summaries: As aggregation stores them: each with ``dataset``, ``algorithm``, ``seeds`` and
            ``points``, a list of statistics with ``lambda`` (None for fixed policies) and, where
            it is known, the interval of the 10th percentile.
        thesis: (dataset, algorithm) -> the thesis's value; only those that are comparable.

    Returns:
        The table; NaN where there is no proximity, no number of the thesis or no interval.
    """
    rows = []
    for summary in summaries:
        printed = thesis.get((summary["dataset"], summary["algorithm"]))
        for point in summary["points"]:
            rows.append(
                {
                    "dataset": summary["dataset"],
                    "algorithm": summary["algorithm"],
                    "proximity": point["lambda"],
                    "seeds": len(summary["seeds"]),
                    "policies": point["policies"],
                    **{name: point[name] for name in _STATISTICS},
                    "thesis_tenth_percentile": printed.value if printed else None,
                    "thesis_standard_error": printed.error if printed else None,
                    **{name: point.get(name) for name in _INTERVAL},
                }
            )
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(_TYPES)


def ended_notes(summaries: Iterable[Mapping[str, Any]]) -> list[str]:
    """A sentence for every seed whose training ended because its loss was no longer finite."""
    return [
        f"{summary['algorithm']} on {summary['dataset']}, seed {seed}: its loss was no longer "
        f"finite at update {step}; its last finite policy stands in for the snapshots after that."
        for summary in summaries
        for seed, step in summary.get("ended_at", {}).items()
    ]


def results_csv(table: pd.DataFrame) -> str:
    """The table as CSV, numbers in full precision."""
    written: str = table.assign(**{name: table[name].map(str) for name in _STATISTICS}).to_csv(
        index=False, lineterminator="\n"
    )
    return written


def undefined_notes(summaries: Iterable[Mapping[str, Any]]) -> list[str]:
    """A sentence for every seed some of whose returns or distances are infinite or undefined."""
    return [
        f"{summary['algorithm']} on {summary['dataset']}, seed {seed}: {count} of its pooled "
        "returns and distances are not finite, as the actions or the system's states were not."
        for summary in summaries
        for seed, count in summary.get("undefined", {}).items()
    ]


def with_undefined(summary: Mapping[str, Any]) -> dict[str, Any]:
    """A stored summary with NaN for statistics that are not finite, which JSON has no numbers for.

    The proximity of policies that take none stays None.
    """
    points = [
        {n: math.nan if v is None and n != "lambda" else v for n, v in point.items()}
        for point in summary["points"]
    ]
    return {**summary, "points": points}


def read_results(path: Path) -> pd.DataFrame:
    """Read a ``results.csv``, the inverse of :func:`results_csv`.

    Raises:
        ValueError: The file has other columns.
    """
    table = pd.read_csv(path, float_precision="round_trip").rename(columns=_FORMER_NAMES)
    if tuple(table.columns) == _FORMER:
        table = table.reindex(columns=list(COLUMNS))
    if tuple(table.columns) != COLUMNS:
        raise ValueError(
            f"{path} has the columns {', '.join(table.columns)}; a table of results has "
            f"{', '.join(COLUMNS)}."
        )
    return table.astype(_TYPES)


def _cell(column: str, value: Any) -> str:
    if column in _STATISTICS and not math.isfinite(value):
        return "not finite"
    if isinstance(value, float):
        digits = 2 if column == "proximity" else 1
        return "" if math.isnan(value) else f"{value:.{digits}f}"
    return str(value)


def markdown_table(table: pd.DataFrame) -> str:
    """The table as aligned Markdown, returns with one decimal."""
    rows = table.to_dict("records")
    columns = [[name, *(_cell(name, row[name]) for row in rows)] for name in COLUMNS]
    lines = []
    for name, cells in zip(COLUMNS, columns, strict=True):
        width = max(map(len, cells))
        text = name in ("dataset", "algorithm")
        rule = "-" * width if text else "-" * (width - 1) + ":"
        cells.insert(1, rule)
        lines.append([cell.ljust(width) if text else cell.rjust(width) for cell in cells])
    return "".join(f"| {' | '.join(cells)} |\n" for cells in zip(*lines, strict=True))
