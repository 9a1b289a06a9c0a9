"""The result table: one row per dataset, algorithm and lambda, beside the thesis's numbers."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

__all__ = [
    "COLUMNS",
    "ended_notes",
    "markdown_table",
    "result_rows",
    "results_csv",
    "thesis_numbers",
]

COLUMNS = (
    "dataset",
    "algorithm",
    "lambda",
    "seeds",
    "policies",
    "tenth_percentile",
    "standard_error",
    "mean",
    "std",
    "iqm",
    "thesis_tenth_percentile",
    "thesis_standard_error",
)
_STATISTICS = ("tenth_percentile", "standard_error", "mean", "std", "iqm")
Row = Mapping[str, Any]


@cache
def thesis_numbers() -> Mapping[tuple[str, str], tuple[float, float]]:
    """Tables 5.3 and 5.4: (dataset, algorithm) -> (10th percentile, standard error)."""
    text = (
        resources.files("components.reporting")
        .joinpath("thesis", "tables_5_3_and_5_4.csv")
        .read_text(encoding="utf-8")
    )
    return {
        (row["dataset"], row["algorithm"]): (
            float(row["tenth_percentile_return"]),
            float(row["standard_error"]),
        )
        for row in csv.DictReader(io.StringIO(text))
    }


def result_rows(summaries: Iterable[Row]) -> list[dict[str, Any]]:
    """Flatten stored summaries into rows with all ``COLUMNS``.

    Args:
        summaries: Each with ``dataset``, ``algorithm``, ``seeds`` and ``points``, a list of
            statistics with ``lambda`` (None for fixed policies).
    """
    rows = []
    for summary in summaries:
        thesis = thesis_numbers().get((summary["dataset"], summary["algorithm"]), (None, None))
        for point in summary["points"]:
            rows.append(
                {
                    "dataset": summary["dataset"],
                    "algorithm": summary["algorithm"],
                    "lambda": point["lambda"],
                    "seeds": len(summary["seeds"]),
                    "policies": point["policies"],
                    **{name: point[name] for name in _STATISTICS},
                    "thesis_tenth_percentile": thesis[0],
                    "thesis_standard_error": thesis[1],
                }
            )
    return rows


def ended_notes(summaries: Iterable[Row]) -> list[str]:
    """A sentence for every seed whose training ended because its loss was no longer finite."""
    return [
        f"{summary['algorithm']} on {summary['dataset']}, seed {seed}: its loss was no longer "
        f"finite at update {step}; its last finite policy stands in for the snapshots after that."
        for summary in summaries
        for seed, step in summary.get("ended_at", {}).items()
    ]


def results_csv(rows: Sequence[Row]) -> str:
    """All rows as CSV; numbers in full precision, missing ones empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: "" if v is None else v for k, v in row.items()} for row in rows])
    return text.getvalue()


def _cell(column: str, value: Any) -> str:
    if value is None:
        return ""
    if column == "lambda":
        return f"{value:.2f}"
    if isinstance(value, float):
        return "not finite" if not math.isfinite(value) else f"{value:.1f}"
    return str(value)


def markdown_table(rows: Sequence[Row]) -> str:
    """The rows as an aligned Markdown table, returns with one decimal."""
    cells = [list(COLUMNS)] + [[_cell(c, row[c]) for c in COLUMNS] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(COLUMNS))]
    numeric = [column not in ("dataset", "algorithm") for column in COLUMNS]

    def line(values: Sequence[str]) -> str:
        padded = [
            v.rjust(w) if right else v.ljust(w)
            for v, w, right in zip(values, widths, numeric, strict=True)
        ]
        return "| " + " | ".join(padded) + " |"

    rule = [
        ("-" * (w - 1) + ":") if right else "-" * w
        for w, right in zip(widths, numeric, strict=True)
    ]
    return "\n".join([line(cells[0]), line(rule), *map(line, cells[1:])]) + "\n"
