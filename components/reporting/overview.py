"""The overview of a sweep: one row per dataset, one column per algorithm.

An algorithm whose policy takes a proximity has three columns: proximity 0, the best, and 1. Below
every number stands its difference to the logged behaviour, and below that the thesis's value where
it can be compared. The long form is :mod:`components.reporting.tables`.
"""

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, Literal

import pandas as pd

from components.reporting.thesis_numbers import Thesis

__all__ = ["Column", "Overview", "Value", "overview", "shown"]

_LEGEND: Final = (
    "Numbers: 10th percentile of the pooled policies' discounted returns in the real system; * the "
    "best of a row; logged: mean return of the logged behaviour."
)
_BEST_LEGEND: Final = (
    "best λ: the best of those that were evaluated, seen in hindsight; fixed policies have no such "
    "choice."
)
_UNLOGGED_LEGEND: Final = (
    "Nothing under logged: the returns of the log are over another number of steps than those of "
    "the policies, or discounted otherwise."
)
_SPREAD_LEGEND: Final = (
    "Spread: the long form has the thesis's standard error, 1.7 sd / √N over N policies, of which "
    "those of one seed resemble each other, and a 95 % interval that draws whole seeds instead."
)

Point = Literal["", "0", "best", "1"]


@dataclass(frozen=True)
class Column:
    """A column: an algorithm, and of one that takes a proximity which."""

    algorithm: str
    point: Point = ""

    @property
    def place(self) -> str:
        """Where on the proximity's range; empty for policies that take none."""
        return {"": "", "best": "best λ"}.get(self.point, f"λ={self.point}")

    @property
    def heading(self) -> str:
        """What stands above it."""
        return f"{self.algorithm} {self.place}".rstrip()


@dataclass(frozen=True)
class Value:
    """What an algorithm achieved on a dataset.

    Attributes:
        value: 10th percentile; NaN: a return was not finite.
        standard_error: As the thesis computes it.
        interval: Seed-clustered, see :mod:`components.aggregation.intervals`; NaN if unknown.
        proximity: Of a column "best", where the best lies; else None.
        difference: To the logged behaviour; None if that is not comparable.
        thesis: Its value if it is comparable; else None.
        best: Whether no value of the row is larger.
    """

    value: float
    standard_error: float
    interval: tuple[float, float]
    proximity: float | None = None
    difference: float | None = None
    thesis: Thesis | None = None
    best: bool = False


@dataclass(frozen=True)
class Overview:
    """Rows and columns.

    Attributes:
        columns: In the order of the algorithms.
        logged: Mean return of every dataset's logged behaviour; None if it is not comparable.
        cells: By dataset and column; what is missing has none.
        footnotes: Sentences by mark.
    """

    columns: Sequence[Column]
    logged: Mapping[str, float | None]
    cells: Mapping[tuple[str, Column], Value]
    footnotes: Mapping[str, str] = field(default_factory=dict)

    def row(self, dataset: str) -> list[Value | None]:
        """The cells of a dataset in the order of the columns."""
        return [self.cells.get((dataset, column)) for column in self.columns]

    def comparable(self, dataset: str) -> dict[Column, Value]:
        """The values of a dataset that may be compared with each other.

        Of several sweeps only those whose returns are counted as the logged behaviour's are, if
        there are any.
        """
        row = zip(self.columns, self.row(dataset), strict=True)
        found = {column: value for column, value in row if value is not None}
        levelled = {column: v for column, v in found.items() if v.difference is not None}
        return levelled or found

    def signs(self) -> list[str]:
        """What its columns and footnotes mean."""
        best = [_BEST_LEGEND] if any(column.point == "best" for column in self.columns) else []
        used = {value.thesis.marks for value in self.cells.values() if value.thesis}
        marked = [f"{m} {text}" for m, text in self.footnotes.items() if any(m in u for u in used)]
        rows = {dataset for dataset, _ in self.cells}
        unlogged = [_UNLOGGED_LEGEND] if any(self.logged[name] is None for name in rows) else []
        return [*unlogged, *best, *marked]

    def notes(self) -> list[str]:
        """What all of it means, for readers of the table alone."""
        return [_LEGEND, _SPREAD_LEGEND, *self.signs()]


def overview(
    table: pd.DataFrame,
    logged: Mapping[str, float | None],
    thesis: Mapping[tuple[str, str], Thesis],
    footnotes: Mapping[str, str],
    levels: Mapping[tuple[str, str], float | None] = MappingProxyType({}),
) -> Overview:
    """Make the overview of a table of results.

    Args:
        table: As :func:`~components.reporting.tables.result_table` makes it.
        logged: Dataset -> mean return of its logged behaviour; None where it is not comparable.
        thesis: (dataset, algorithm) -> the thesis's value; only those that are comparable.
        footnotes: Sentences by the marks of the thesis's values.
        levels: (dataset, algorithm) -> what stands for `logged` where that is not the same for all.
    """
    columns: dict[Column, None] = {}
    cells: dict[tuple[str, Column], Value] = {}
    for (dataset, algorithm), rows in table.groupby(["dataset", "algorithm"], sort=False):
        name = str(dataset)
        level = levels.get((name, str(algorithm)), logged.get(name))
        for point, row in _points(rows):
            columns.setdefault(Column(str(algorithm), point))
            value = float(row["tenth_percentile"])
            cells[name, Column(str(algorithm), point)] = Value(
                value,
                float(row["standard_error"]),
                (float(row["interval_low"]), float(row["interval_high"])),
                float(row["proximity"]) if point == "best" else None,
                None if level is None else value - level,
                thesis.get((name, str(algorithm))),
            )
    names = [str(name) for name in table["dataset"].unique()]
    order = [column.algorithm for column in columns]
    made = Overview(
        sorted(columns, key=lambda column: order.index(column.algorithm)),
        {name: logged.get(name) for name in names},
        cells,
        footnotes,
    )
    for name in names:
        _mark_best(cells, made.comparable(name))
    return made


def _points(rows: pd.DataFrame) -> Iterator[tuple[Point, Mapping[Hashable, Any]]]:
    """The rows of a (dataset, algorithm) pair that the overview shows."""
    ordered = rows.sort_values("proximity").to_dict("records")
    if rows["proximity"].isna().all():
        yield "", ordered[0]
        return
    yield "0", ordered[0]
    yield "best", max(ordered, key=lambda row: _or_least(row["tenth_percentile"]))
    yield "1", ordered[-1]


def _or_least(value: float) -> float:
    return value if math.isfinite(value) else -math.inf


def _mark_best(cells: dict[tuple[str, Column], Value], row: Mapping[Column, Value]) -> None:
    best = max((v.value for v in row.values() if math.isfinite(v.value)), default=math.nan)
    for key, value in list(cells.items()):
        if row.get(key[1]) is value and value.value == best:
            cells[key] = replace(value, best=True)


def shown(value: float, sign: bool = False) -> str:
    """A return with one decimal; "not finite" if a policy has diverged."""
    if not math.isfinite(value):
        return "not finite"
    rounded = round(value, 1) + 0.0  # without the sign of a negative zero
    return f"{rounded:+.1f}" if sign else f"{rounded:.1f}"
