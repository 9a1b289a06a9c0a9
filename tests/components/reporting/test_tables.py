"""The result table: columns, thesis numbers, CSV and Markdown."""

import io
import math
from pathlib import Path

import pandas
import pytest

from components.reporting.tables import (
    COLUMNS,
    markdown_table,
    result_rows,
    results_csv,
    thesis_numbers,
)
from tests.components.reporting.summaries import LION, TD3_BC, point

CONF = Path(__file__).parents[3] / "conf" / "dataset"

PROMISED = [
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
]


def test_columns_are_the_promised_ones() -> None:
    assert list(COLUMNS) == PROMISED
    for row in result_rows([TD3_BC, LION]):
        assert list(row) == PROMISED


def test_thesis_numbers_are_joined() -> None:
    numbers = thesis_numbers()
    assert numbers["mediocre-0.2", "td3_bc"] == (-77.7, 0.1)
    assert numbers["optimized-0.6", "td3_bc"] == (-62.7, 0.1)
    assert sum(algorithm == "td3_bc" for _, algorithm in numbers) >= 19
    missing = [path.stem for path in CONF.glob("*.yaml") if (path.stem, "td3_bc") not in numbers]
    assert missing == []
    [row] = result_rows([TD3_BC])
    assert (row["thesis_tenth_percentile"], row["thesis_standard_error"]) == (-77.7, 0.1)
    assert (row["seeds"], row["policies"]) == (5, 10)


def test_rows_follow_the_points() -> None:
    rows = result_rows([TD3_BC, LION])
    assert [row["lambda"] for row in rows] == [None, 0.0, 0.5, 1.0]
    assert [row["mean"] for row in rows] == [-77.0, -90.0, -70.0, -80.0]
    assert {row["thesis_tenth_percentile"] for row in rows[1:]} == {None}


def test_csv_reads_back_in_full_precision() -> None:
    text = results_csv(result_rows([TD3_BC, LION]))
    assert text.splitlines()[0] == ",".join(PROMISED)
    assert text.splitlines()[1].startswith("mediocre-0.2,td3_bc,,5,10,")
    frame = pandas.read_csv(io.StringIO(text))
    assert list(frame.columns) == PROMISED
    assert len(frame) == 4
    assert frame["lambda"].isna().tolist() == [True, False, False, False]
    assert frame["tenth_percentile"][0] == -77.0 - 5.123456789
    assert frame["thesis_tenth_percentile"].isna().tolist() == [False, True, True, True]


def test_a_figure_that_is_not_finite_is_shown() -> None:
    bad = point(None) | {"mean": math.nan, "tenth_percentile": math.nan}
    rows = result_rows([TD3_BC | {"points": [bad]}])
    frame = pandas.read_csv(io.StringIO(results_csv(rows)))
    assert math.isnan(frame["mean"][0])
    assert "not finite" in markdown_table(rows)


def test_markdown() -> None:
    lines = markdown_table(result_rows([TD3_BC, LION])).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == PROMISED
    assert all(set(cell) <= set("-:") for cell in cells[1])
    assert cells[2] == [
        "mediocre-0.2", "td3_bc", "", "5", "10", "-82.1", "0.2", "-77.0", "1.5", "-76.9", "-77.7",
        "0.1",
    ]  # fmt: skip
    assert cells[4][2] == "0.50"
    assert cells[4][-2:] == ["", ""]
    assert len({len(line) for line in lines}) == 1, "columns are aligned"


@pytest.mark.parametrize("rows", [[]])
def test_an_empty_table_has_its_head(rows: list) -> None:
    assert results_csv(rows) == ",".join(PROMISED) + "\n"
    assert len(markdown_table(rows).splitlines()) == 2
