"""What tables of studies say of curves that can be read by eye."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from flows.pipeline.plan import Node
from flows.studies.finished import Cell
from flows.studies.over_proximity import proximity_table
from flows.studies.trade_offs import TradeOff, trade_off_table

NODE = Node(component="aggregation", name="none", task="none:none", version=1, config={})


def cell(returns: list[float], label: str = "lion") -> Cell:
    proximities = np.linspace(0.0, 1.0, len(returns))
    points: list[dict[str, Any]] = [
        {"lambda": float(p), "mean": r, "seed_std": 0.0, "distance": float(p)}
        for p, r in zip(proximities, returns, strict=True)
    ]
    return Cell("bad-0.4", "lion", label, {}, points, NODE)


def test_a_curve_that_rises_and_falls_below_the_log() -> None:
    # The log's return is -100: a loss is more than 2 of them.
    found = [cell([-101.0, -80.0, -83.0, -99.0, -110.0]), cell([-100.0] * 5), cell([-120.0] * 5)]
    table = proximity_table(found, {"bad-0.4": -100.0}, ["falls", "stays", "never"])
    falls, stays, never = (row for _, row in table.iterrows())
    assert (falls["at 0"], falls["best"], falls["at 1"]) == (-101.0, -80.0, -110.0)
    assert falls["best λ"] == 0.25
    assert falls["below the log from λ"] == 1.0
    assert falls["drops"] == 3
    assert falls["reach"] == 30.0
    assert falls["distance at 1"] == 1.0
    assert pd.isna(stays["below the log from λ"])
    assert (stays["drops"], stays["reach"]) == (0, 0.0)
    assert never["below the log from λ"] == 0.0


def test_an_undefined_return_is_no_good_one() -> None:
    table = proximity_table([cell([-90.0, -80.0, np.nan])], {"bad-0.4": -100.0}, ["breaks"])
    assert table.loc[0, "best"] == -80.0
    assert table.loc[0, "below the log from λ"] == 1.0
    assert table.loc[0, "drops"] == 1


def test_a_user_stops_before_the_best_of_a_zigzag() -> None:
    returns = np.array([-90.0, -85.0, -88.0, -60.0, -70.0])
    penalty = np.array([2.0, 1.5, 1.0, 0.5, 0.0])
    entry = TradeOff("bad-0.4", "mopo", penalty, returns, np.zeros(5), np.zeros(5))
    table = trade_off_table([entry], {"bad-0.4": -100.0})
    [row] = table.to_dict("records")
    assert (row["start"], row["knob"], row["final return"]) == (-90.0, 1.5, -85.0)
    assert (row["tried"], row["worst tried"]) == (3, -90.0)
    assert (row["best there is"], row["at"]) == (-60.0, 0.5)
    assert row["zigzag"] == 6.0, "down by 3 and up again, before the best"
    # what thesis table 6.1 prints for MOPO on this log
    assert (row["thesis knob"], row["thesis return"]) == (2.4, -107.2)


@pytest.mark.parametrize(("algorithm", "knob"), [("lion", 0.2), ("rvs", -75.0)])
def test_the_thesis_stands_beside_its_own_logs_alone(algorithm: str, knob: float) -> None:
    one = (np.array([0.0]), np.array([-70.0]), np.zeros(1), np.zeros(1))
    entries = [TradeOff(name, algorithm, *one) for name in ("mediocre-0.0", "bad-0.0")]
    table = trade_off_table(entries, {"mediocre-0.0": -78.0, "bad-0.0": -327.0})
    assert table.loc[0, "thesis knob"] == knob
    assert pd.isna(table.loc[1, "thesis knob"])
    assert pd.isna(table.loc[1, "thesis return"])
