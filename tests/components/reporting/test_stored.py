"""Reading reports back: typed rows, the right summaries, one sentence where one is missing."""

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest

from components.reporting.stored import (
    figures_over_lambda,
    find_store,
    open_report,
    read_results,
)
from components.reporting.tables import result_rows, results_csv

STATISTICS = ("tenth_percentile", "standard_error", "mean", "std", "iqm")


def summary(
    algorithm: str, lambdas: list[float | None], dataset: str = "mediocre-0.2", base: float = -80.0
) -> dict[str, Any]:
    points = [
        {
            "lambda": value,
            **{name: base + n / 3 + i for i, name in enumerate(STATISTICS)},
            "policies": 4,
            "seed_std": 0.5,
            "distance": 0.1 * n,
        }
        for n, value in enumerate(lambdas)
    ]
    return {"dataset": dataset, "algorithm": algorithm, "seeds": [0, 1], "points": points}


def node(store: Path, key: str, inputs: dict[str, str], file: str, content: Any) -> None:
    path = store / "nodes" / key / file
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    (store / "nodes" / key / "node.json").write_text(json.dumps({"inputs": inputs}))


def write_report(store: Path, sweep: str, summaries: list[dict[str, Any]], age: int = 0) -> Path:
    table = store / "reports" / sweep / "results.csv"
    table.parent.mkdir(parents=True)
    table.write_text(results_csv(result_rows(summaries)), encoding="utf-8")
    os.utime(table, (1_000_000 - age, 1_000_000 - age))
    return table


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Two sweeps whose nodes share one folder, with different datasets of the same name."""
    store = tmp_path / "mlruns"
    ours, theirs = summary("lion", [0.0, 0.5, 1.0]), summary("lion", [0.0, 0.5, 1.0], base=-1.0)
    fixed = summary("td3_bc", [None])
    for name, returns in (("ours", -90.0), ("theirs", -7.0)):
        card = {"first_window_return_mean": returns}
        node(store, f"data-{name}", {}, "dataset/card.json", card)
        node(store, f"train-{name}", {"dataset": f"data-{name}"}, "curves.json", {})
    node(store, "1", {"seed0": "train-theirs"}, "summary.json", theirs)
    node(store, "2", {"seed0": "train-ours"}, "summary.json", fixed)
    node(store, "3", {"seed0": "train-ours"}, "summary.json", ours)
    write_report(store, "new", [ours, fixed])
    write_report(store, "old", [theirs], age=60)
    return store


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    odd = summary("lion", [0.05])
    odd["points"][0] |= {"mean": math.inf, "std": 1 / 3}
    rows = result_rows([summary("td3_bc", [None]), odd])
    assert read_results(write_report(tmp_path, "s", [summary("td3_bc", [None]), odd])) == rows
    assert rows[0]["thesis_tenth_percentile"] == -77.7
    assert rows[1]["thesis_tenth_percentile"] is None


def test_a_table_with_other_columns_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "results.csv"
    table.write_text("dataset,score\nx,1\n")
    with pytest.raises(ValueError, match=r"results\.csv has the columns .*score.*has dataset, alg"):
        read_results(table)


def test_a_report_takes_its_own_summaries_only(store: Path) -> None:
    report = open_report(store)
    assert report.folder.name == "new"  # the newest
    assert [s["algorithm"] for s in report.summaries] == ["lion", "td3_bc"]  # in the table's order
    assert report.summaries[0]["points"][0]["mean"] == -78.0
    assert report.behaviour_returns == {"mediocre-0.2": -90.0}
    old = open_report(store, "old")
    assert [s["points"][0]["mean"] for s in old.summaries] == [1.0]
    assert old.behaviour_returns == {"mediocre-0.2": -7.0}


def test_statistics_that_are_not_numbers_still_find_their_summary(tmp_path: Path) -> None:
    broken = summary("td3_bc", [None])
    broken["points"][0] |= {"mean": math.nan}
    node(tmp_path, "1", {}, "summary.json", broken)
    write_report(tmp_path, "s", [broken])
    assert len(open_report(tmp_path).summaries) == 1


def test_a_table_without_its_artifacts_can_still_be_read(tmp_path: Path) -> None:
    write_report(tmp_path, "s", [summary("lion", [0.0, 1.0])])
    report = open_report(tmp_path)
    assert len(report.rows) == 2
    assert not report.summaries
    assert not figures_over_lambda(report)


def test_missing_reports_are_named(store: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no report of 'newer'; there are new, old\."):
        open_report(store, "newer")
    with pytest.raises(FileNotFoundError, match="holds no report yet; run the benchmark"):
        open_report(tmp_path)


def test_figures_are_drawn_where_a_policy_takes_lambda(store: Path) -> None:
    figures = figures_over_lambda(open_report(store))
    assert list(figures) == ["mediocre-0.2"]
    upper = figures["mediocre-0.2"].axes[0]
    assert list(upper.lines[0].get_ydata()) == pytest.approx([-78.0, -78.0 + 1 / 3, -78.0 + 2 / 3])
    assert [line.get_ydata()[0] for line in upper.lines[1:]] == [-78.0, -90.0]


def test_the_nearest_store_is_found_from_below(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    below = tmp_path / "notebooks"
    below.mkdir()
    monkeypatch.chdir(below)
    assert find_store("mlruns") == store
    assert find_store(store) == store
    with pytest.raises(FileNotFoundError, match=r"No folder elsewhere with reports in .* set PROX"):
        find_store("elsewhere")
