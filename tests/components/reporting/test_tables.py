"""The result table: columns, thesis numbers, CSV and Markdown."""

import csv
import io
import math
from pathlib import Path

import pandas
import pytest

from components.reporting.tables import (
    COLUMNS,
    markdown_table,
    read_results,
    result_table,
    results_csv,
    undefined_notes,
    with_undefined,
)
from components.reporting.thesis_numbers import Thesis, thesis_numbers
from tests.components.reporting.summaries import LION, TD3_BC, point

CONF = Path(__file__).parents[3] / "conf" / "dataset"

PROMISED = [
    "dataset",
    "algorithm",
    "proximity",
    "seeds",
    "policies",
    "tenth_percentile",
    "standard_error",
    "mean",
    "std",
    "iqm",
    "thesis_tenth_percentile",
    "thesis_standard_error",
    "interval_low",
    "interval_high",
]


def test_columns_are_the_promised_ones() -> None:
    assert list(COLUMNS) == PROMISED
    assert list(result_table([TD3_BC, LION])) == PROMISED
    assert list(result_table([])) == PROMISED


PRINTED = {("mediocre-0.2", "td3_bc"): Thesis(-77.7, 0.1)}


def test_thesis_numbers_are_joined() -> None:
    numbers = thesis_numbers()
    assert numbers["mediocre-0.2", "td3_bc"] == (-77.7, 0.1)
    assert numbers["optimized-0.6", "td3_bc"] == (-62.7, 0.1)
    assert sum(algorithm == "td3_bc" for _, algorithm in numbers) >= 19
    missing = [path.stem for path in CONF.glob("*.yaml") if (path.stem, "td3_bc") not in numbers]
    assert missing == ["world"]  # a sanity check, which the tables of the thesis do not have
    [alone] = result_table([TD3_BC]).to_dict("records")
    assert math.isnan(alone["thesis_tenth_percentile"]), "none that is counted likewise"
    [row] = result_table([TD3_BC], PRINTED).to_dict("records")
    assert (row["thesis_tenth_percentile"], row["thesis_standard_error"]) == (-77.7, 0.1)
    assert (row["seeds"], row["policies"]) == (5, 10)


def test_rows_follow_the_points() -> None:
    table = result_table([TD3_BC, LION], PRINTED)
    assert table["proximity"].fillna(-1).tolist() == [-1, 0.0, 0.5, 1.0]
    assert table["mean"].tolist() == [-77.0, -90.0, -70.0, -80.0]
    assert table["thesis_tenth_percentile"].isna().tolist() == [False, True, True, True]


def test_csv_reads_back_in_full_precision() -> None:
    text = results_csv(result_table([TD3_BC, LION], PRINTED))
    assert text.splitlines()[0] == ",".join(PROMISED)
    assert text.splitlines()[1].startswith("mediocre-0.2,td3_bc,,5,10,")
    frame = pandas.read_csv(io.StringIO(text))
    assert list(frame.columns) == PROMISED
    assert len(frame) == 4
    assert frame["proximity"].isna().tolist() == [True, False, False, False]
    assert frame["tenth_percentile"][0] == -77.0 - 5.123456789
    assert frame["thesis_tenth_percentile"].isna().tolist() == [False, True, True, True]


def test_a_figure_that_is_not_finite_is_shown() -> None:
    bad = point(None) | {"mean": math.nan, "tenth_percentile": math.nan}
    table = result_table([TD3_BC | {"points": [bad, bad | {"mean": -math.inf}]}], PRINTED)
    first, second = results_csv(table).splitlines()[1:]
    # what is not a number differs from what is not there
    assert first == "mediocre-0.2,td3_bc,,5,10,nan,0.25,nan,1.5,-69.875,-77.7,0.1,,"
    assert second == "mediocre-0.2,td3_bc,,5,10,nan,0.25,-inf,1.5,-69.875,-77.7,0.1,,"
    assert markdown_table(table).count("not finite") == 4


def test_what_json_has_no_number_for_is_undefined_again() -> None:
    stored = TD3_BC | {"points": [point(None) | {"mean": None, "std": None}]}
    [bad] = with_undefined(stored)["points"]
    assert (bad["lambda"], math.isnan(bad["mean"]), math.isnan(bad["std"])) == (None, True, True)
    assert bad["iqm"] == point(None)["iqm"]
    assert markdown_table(result_table([with_undefined(stored)])).count("not finite") == 2


def test_returns_that_are_not_finite_are_noted() -> None:
    [note] = undefined_notes([TD3_BC, LION | {"undefined": {"3": 7}}])
    assert note.startswith(
        "lion on mediocre-0.2, seed 3: 7 of its pooled returns and distances are"
    )


NUMBERS = [
    1 / 3,
    -0.1 - 0.2,
    5e-324,
    1.7976931348623157e308,
    1e22,
    -1e-7,
    123456789.0,
    2 / 3 * 1e-5,
]


def test_numbers_are_written_as_python_writes_them_and_come_back(tmp_path: Path) -> None:
    points = [point(n / 3) | {"mean": value} for n, value in enumerate(NUMBERS[:4])]
    points += [point(None) | {"iqm": value} for value in NUMBERS[4:]]
    table = result_table([TD3_BC, LION | {"points": points}])
    text = results_csv(table)
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["mean"] for row in rows[1:5]] == [repr(value) for value in NUMBERS[:4]]
    assert [row["iqm"] for row in rows[5:]] == [repr(value) for value in NUMBERS[4:]]
    assert [row["proximity"] for row in rows[1:4]] == ["0.0", repr(1 / 3), repr(2 / 3)]
    path = tmp_path / "results.csv"
    path.write_text(text)
    pandas.testing.assert_frame_equal(read_results(path), table, check_exact=True)


def test_older_tables_call_the_proximity_lambda(tmp_path: Path) -> None:
    table = result_table([TD3_BC, LION])
    path = tmp_path / "results.csv"
    path.write_text(results_csv(table).replace(",proximity,", ",lambda,", 1))
    pandas.testing.assert_frame_equal(read_results(path), table)


def test_older_tables_have_no_intervals(tmp_path: Path) -> None:
    table = result_table([TD3_BC])
    path = tmp_path / "results.csv"
    path.write_text(results_csv(table.drop(columns=["interval_low", "interval_high"])))
    pandas.testing.assert_frame_equal(read_results(path), table)


def test_intervals_are_those_of_the_points() -> None:
    known = point(None) | {"interval_low": -78.5, "interval_high": -76.25}
    [row] = result_table([TD3_BC | {"points": [known]}]).to_dict("records")
    assert (row["interval_low"], row["interval_high"]) == (-78.5, -76.25)


def test_a_table_with_other_columns_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text("dataset,score\nx,1\n")
    with pytest.raises(ValueError, match=r"results\.csv has the columns .*score; .*has dataset"):
        read_results(path)


def test_markdown() -> None:
    lines = markdown_table(result_table([TD3_BC, LION], PRINTED)).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == PROMISED
    assert all(set(cell) <= set("-:") for cell in cells[1])
    assert cells[2] == [
        "mediocre-0.2", "td3_bc", "", "5", "10", "-82.1", "0.2", "-77.0", "1.5", "-76.9", "-77.7",
        "0.1", "", "",
    ]  # fmt: skip
    assert cells[4][2] == "0.50"
    assert cells[4][-4:] == ["", "", "", ""]
    assert len({len(line) for line in lines}) == 1, "columns are aligned"


def test_an_empty_table_has_its_head() -> None:
    table = result_table([])
    assert results_csv(table) == ",".join(PROMISED) + "\n"
    assert len(markdown_table(table).splitlines()) == 2
