"""The results that the thesis prints; read without pandas, because every plan needs their names."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

__all__ = ["Thesis", "thesis_numbers"]


@dataclass(frozen=True)
class Thesis:
    """The thesis's value of a cell and the footnotes that it needs.

    Attributes:
        value: 10th percentile.
        error: Its standard error.
        marks: Of the footnotes, e.g. "¹".
        other_discount: Whether it is discounted otherwise, so that it is no measure of agreement.
    """

    value: float
    error: float
    marks: str = ""
    other_discount: bool = False


@cache
def thesis_numbers() -> Mapping[tuple[str, str], tuple[float, float]]:
    """Tables 5.3 and 5.4: (dataset, algorithm) -> (10th percentile, standard error)."""
    file = resources.files("components.reporting").joinpath("thesis", "tables_5_3_and_5_4.csv")
    with file.open(encoding="utf-8") as opened:
        return {
            (row["dataset"], row["algorithm"]): (
                float(row["tenth_percentile_return"]),
                float(row["standard_error"]),
            )
            for row in csv.DictReader(opened)
        }
