"""The data behind a report, and what docs/report.md makes of it for a paper."""

import re
from pathlib import Path
from typing import Any

import pytest

from components.reporting.policies import policy_table
from tests.components.reporting.evidence import evidence
from tests.conftest import ROOT

LOGGED = {"bad-0.4": -214.0, "mediocre-0.2": -90.0}


@pytest.fixture
def paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that the page's example defines."""
    table = policy_table(evidence()).assign(commit="abc")
    table["logged"] = table["dataset"].map(LOGGED)
    file = tmp_path / "mlruns" / "reports" / "quick" / "policies.parquet"
    file.parent.mkdir(parents=True)
    table.to_parquet(file)
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    [code] = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    return names


def test_the_example_for_a_paper_has_curves_scores_and_sources(paper: dict[str, Any]) -> None:
    scores = paper["scores"]
    assert scores.groupby("dataset").max().to_list() == [1.0, 1.0], "the best run"
    for (_, dataset), own in scores.groupby(["algorithm", "dataset"]):
        assert own.lt(0).all() == paper["runs"][own.index].lt(LOGGED[dataset]).all()
    of_clone, best = scores.loc["bc", "bad-0.4"].mean(), paper["best"]["bad-0.4"]
    assert of_clone == pytest.approx((-220.0 + 214.0) / (best + 214.0))
    for name, row in paper["table"].items():
        assert row["low"] <= row["IQM"] <= row["high"], name
    assert paper["latex"].count(r"\\") == 1 + len(paper["table"])
    assert len(paper["curves"]) == len(paper["curve_deviations"]) == 4
    assert paper["made_by"].groupby(["dataset", "algorithm", "seed"]).size().eq(1).all()
