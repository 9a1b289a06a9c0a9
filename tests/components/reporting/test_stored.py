"""Reading reports back: the right summaries, and one sentence where something is missing."""

import json
import os
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from components.core.integrity import DamagedFileError
from components.core.sealed import seal
from components.reporting.stored import (
    ReportNodes,
    figures_over_proximity,
    find_store,
    open_report,
)
from components.reporting.tables import result_table, results_csv

STATISTICS = ("tenth_percentile", "standard_error", "mean", "std", "iqm")


def summary(
    algorithm: str,
    proximities: list[float | None],
    dataset: str = "mediocre-0.2",
    base: float = -80.0,
) -> dict[str, Any]:
    points = [
        {
            "lambda": value,
            **{name: base + n / 3 + i for i, name in enumerate(STATISTICS)},
            "policies": 4,
            "seed_std": 0.5,
            "distance": 0.1 * n,
        }
        for n, value in enumerate(proximities)
    ]
    return {"dataset": dataset, "algorithm": algorithm, "seeds": [0, 1], "points": points}


def node(store: Path, key: str, file: str, content: Any) -> None:
    path = store / "nodes" / key / file
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    seal(store / "nodes" / key, {"key": key})


def write_report(
    store: Path, sweep: str, summaries: dict[str, dict[str, Any]], data: str, age: int = 0
) -> Path:
    """A report of summaries by key."""
    table = store / "reports" / sweep / "results.csv"
    table.parent.mkdir(parents=True)
    table.write_text(results_csv(result_table(summaries.values())), encoding="utf-8")
    ReportNodes(tuple(summaries), {"mediocre-0.2": data}).save(table.parent)
    os.utime(table, (1_000_000 - age, 1_000_000 - age))
    return table


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Two sweeps whose nodes share one folder, with the same numbers of different datasets."""
    store = tmp_path / "mlruns"
    ours, fixed = summary("lion", [0.0, 0.5, 1.0]), summary("td3_bc", [None])
    for name, returns in (("ours", -90.0), ("theirs", -7.0)):
        node(store, f"data-{name}", "dataset/card.json", {"first_window_return_mean": returns})
    node(store, "1", "summary.json", ours | {"seeds": [7, 8]})
    node(store, "2", "summary.json", fixed)
    node(store, "3", "summary.json", ours)
    write_report(store, "new", {"3": ours, "2": fixed}, "data-ours")
    write_report(store, "old", {"1": ours}, "data-theirs", age=60)
    return store


def test_a_report_takes_its_own_summaries_only(store: Path) -> None:
    report = open_report(store, "new")
    assert report.folder.name == "new"
    assert [s["algorithm"] for s in report.summaries] == ["lion", "td3_bc"]  # in the table's order
    assert [s["seeds"] for s in report.summaries] == [[0, 1], [0, 1]]
    assert report.behaviour_returns == {"mediocre-0.2": -90.0}
    pd.testing.assert_frame_equal(report.table, result_table(report.summaries))
    old = open_report(store, "old")
    assert [s["seeds"] for s in old.summaries] == [[7, 8]]  # whose rows are the same
    assert old.behaviour_returns == {"mediocre-0.2": -7.0}


def test_a_table_without_its_artifacts_can_still_be_read(tmp_path: Path) -> None:
    write_report(tmp_path, "s", {"1": summary("lion", [0.0, 1.0])}, "data")
    report = open_report(tmp_path)
    assert len(report.table) == 2
    assert not report.summaries
    assert not figures_over_proximity(report)


@pytest.mark.parametrize("name", ["3/summary.json", "data-ours/dataset/card.json"])
def test_a_damaged_artifact_is_named(store: Path, name: str) -> None:
    path = store / "nodes" / name
    whole = path.read_text()
    path.write_text(whole.replace("9", "8", 1))
    with pytest.raises(DamagedFileError, match=f"{path} is damaged .*give the command of its sw"):
        open_report(store, "new")
    path.unlink()
    with pytest.raises(DamagedFileError, match=f"{path} is missing; give the command of its sw"):
        open_report(store, "new")


def test_a_report_of_an_older_version_asks_for_its_command(store: Path) -> None:
    path = store / "reports" / "old" / "report.json"
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"report\.json is missing; give the sweep's comm"):
        open_report(store, "old")
    path.write_text("{")
    with pytest.raises(ValueError, match=r"report\.json cannot be used .*; give the sweep's comm"):
        open_report(store, "old")


def test_missing_reports_are_named(store: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no report of 'newer'; there are new, old\."):
        open_report(store, "newer")
    with pytest.raises(FileNotFoundError, match="holds no report yet; run the benchmark"):
        open_report(tmp_path)


def test_of_several_reports_none_is_taken_that_was_not_asked_for(store: Path) -> None:
    for nothing in (None, ""):
        with pytest.raises(ValueError, match=r"several sweeps: new, old; .* PROXIMITY_SWEEP\."):
            open_report(store, nothing)


def test_figures_are_drawn_where_a_policy_takes_proximity(store: Path) -> None:
    figures = figures_over_proximity(open_report(store, "new"))
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
