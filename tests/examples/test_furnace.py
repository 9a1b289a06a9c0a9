"""The worked example: its plant behaves as its page says, and all of its steps run."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from examples.furnace.compare import borne_out, chosen, comparison, comparison_figure
from examples.furnace.log import logged
from examples.furnace.plant import BOUNDS, FEATURES
from examples.furnace.trial import operators_trial, returns_of
from tests.conftest import ROOT

SHIFTS, ROWS, BOLDNESS = 40, 150, 25.0


def constant(set_point: float, ratio: float) -> dict[str, float]:
    """Furnaces whose settings never change."""
    settings = np.tile([set_point, ratio], (SHIFTS, 1))
    return returns_of(lambda readings: settings, SHIFTS, ROWS)


def test_leaner_air_saves_money_as_far_as_the_cliff() -> None:
    usual, leaner, starved = (constant(1150, ratio)["euros_per_hour"] for ratio in (13, 11, 10))
    # The same weather in all: the differences are 20 and 50 euros, and come out in every seed.
    assert leaner > usual + 10
    assert starved < leaner - 20


def test_there_is_more_to_gain_than_the_operators_do() -> None:
    operators, best = operators_trial(SHIFTS, ROWS, BOLDNESS), constant(1150, 11)
    assert best["return"] > operators["return"] + 5 * operators["standard_error"]


def test_the_profit_of_a_row_is_that_of_the_step_before() -> None:
    log = logged(2, 50, BOLDNESS, seed=3)
    assert list(log.columns) == [
        "time", "shift", *FEATURES, *BOUNDS, "manual", "profit",
    ]  # fmt: skip
    assert log.groupby("shift").size().tolist() == [50, 50]
    gas, wrong = log["gas"] / 120, (log["temperature"] - 1150) / 10
    lost = 0.35 * gas + 0.015 * log["throughput"] * wrong**2  # prices and readings of a row
    error = {rows: (log["profit"].shift(rows) + lost).abs().mean() for rows in (-1, 0, 1)}
    assert error[0] < 0.06  # noise of the readings
    assert min(error[-1], error[1]) > 1.2 * error[0]
    pd.testing.assert_frame_equal(log, logged(2, 50, BOLDNESS, seed=3))


def judged(returns: list[float], **estimates: list[float]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Judgements and trials of a LION policy."""
    keys = pd.DataFrame(
        {"algorithm": "lion", "seed": 0, "proximity": np.linspace(0, 1, len(returns))}
    )
    empty = {name: returns for name in ("model", "fitted_q", "score_cautious_1", "outside")}
    judgements = keys.assign(true_return=np.nan, **{**empty, **estimates})
    return judgements, keys.assign(**{"return": returns}, euros_per_hour=returns)


def test_estimates_are_ranked_beside_the_plant() -> None:
    judgements, trials = judged([-3.0, -1.0, -2.0], fitted_q=[3.0, 1.0, 2.0])
    joined = comparison(judgements, trials)
    found = borne_out(joined)["all"].tolist()
    assert found == pytest.approx([1, -1, 1, -1])  # of what is outside, less is better
    joined["score_odd"] = [0.0, 1.0, 2.0]
    table = chosen(joined).set_index("score")
    assert table["proximity"].to_dict() == {
        "cautious_1": 0.5, "odd": 1.0, "(truth)": 0.5,
    }  # fmt: skip
    assert table.loc["odd", "euros_per_hour"] == -2.0
    figure = comparison_figure(joined, {"return": -2.5})
    above, below = figure.axes
    assert len(above.lines) == 4
    assert below.lines[0].get_ydata().tolist() == [-300, -100, -200]
    with pytest.raises(ValueError, match=r"^Some policies were not judged; run the sweep"):
        comparison(judgements[:1], trials)


@pytest.mark.slow(40)
def test_all_steps_run_and_write_nothing_into_the_project(tmp_path: Path) -> None:
    folder = tmp_path / "example"
    done = subprocess.run(
        [sys.executable, "-m", "examples.furnace.run", "--small", "--folder", str(folder)],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != "MLFLOW_TRACKING_URI"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for door in ("import_log", "rank_datasets", "full_benchmark", "export_policy"):
        assert f"$ python -m flows.{door} " in done.stdout
    assert "order of the datasets" not in done.stdout  # there is one
    table = pd.read_csv(folder / "comparison.csv")
    assert table["algorithm"].tolist() == ["bc"] + ["lion"] * 11
    assert np.isfinite(table[["return", "model", "fitted_q", "outside"]]).all(axis=None)
    assert (folder / "comparison.png").stat().st_size > 10_000
    assert (folder / "conf" / "dataset" / "furnace.yaml").is_file()
    assert "episode: shift" in (folder / "draft.yaml").read_text(encoding="utf-8")
    assert not (ROOT / "conf" / "dataset" / "furnace.yaml").exists()
    assert not (ROOT / "logs" / "furnace").exists()
