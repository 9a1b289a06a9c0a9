"""Tables of judged policies."""

import numpy as np
import pandas as pd
import pytest

from components.aggregation.selection import SCORES, scored
from components.reporting.selection import judge_table, selection_markdown, selection_table


def policies() -> pd.DataFrame:
    """Two seeds of a fixed policy and of one at two proximities, on two logs."""
    rows = []
    for dataset in ("second", "first"):  # the order of the plan, not of the alphabet
        for seed in (0, 1):
            for proximity, value in ((np.nan, -9.0), (0.0, -10.0), (1.0, -8.0 - 8 * seed)):
                name = "bc" if np.isnan(proximity) else "lion"
                rows.append((dataset, name, seed, 5, proximity, value, value - 0.5 * seed))
    columns = ["dataset", "algorithm", "seed", "step", "proximity", "model", "true_return"]
    table = pd.DataFrame(rows, columns=columns)
    same = dict.fromkeys(("distance", "outside"), 0.1)
    table = table.assign(
        model_error=0.3, model_least=table["model"] - 1, fitted_q=table["model"],
        fitted_q_error=0.4, promised=np.nan, **same,
    )  # fmt: skip
    usual = {"model": -10, "model_least": -11, "fitted_q": -10, **same}
    usual |= {"model_error": 0.4, "fitted_q_error": 0.3}
    return scored(table.assign(**{f"{name}_usual": value for name, value in usual.items()}))


def test_seeds_stand_together_and_the_best_stands_first() -> None:
    table = selection_table(policies(), "model")
    assert list(table["dataset"]) == ["second"] * 3 + ["first"] * 3
    first = table.head(3)
    assert list(first["algorithm"]) == ["bc", "lion", "lion"]
    np.testing.assert_array_equal(first["proximity"], [np.nan, 0.0, 1.0])
    assert list(first["score"]) == [1.0, 0.0, -2.0]
    assert (table["policies"] == 2).all()
    assert {f"score_{name}" for name in SCORES} < set(table.columns)


def test_errors_hold_those_of_the_policies_and_their_spread() -> None:
    first = selection_table(policies(), "model").head(3)
    alike = 0.3 / np.sqrt(2)  # of two equal policies
    apart = np.sqrt((0.3**2 + np.var([-8.0, -16.0], ddof=1)) / 2)
    assert first["model_error"].tolist() == pytest.approx([alike, alike, apart])


def test_only_the_first_rows_of_every_log_are_printed_and_the_best_of_every_algorithm() -> None:
    lion = policies().query("algorithm == 'lion'")
    bc = policies().query("algorithm == 'bc'").assign(score_model=-99.0)
    many = [lion.assign(proximity=lion["proximity"] + 2 * n) for n in range(9)]
    text = selection_markdown(selection_table(pd.concat([*many, bc]), "model"))
    for log in ("second", "first"):
        rows = [line for line in text.splitlines() if f"| {log} " in line]
        assert [f"| {name} " in row for row in rows for name in ("lion", "bc")].count(True) == 13
        assert "| bc " in rows[-1], "a single row of 19, and the last one"


def test_what_is_printed_are_gains_beside_the_score() -> None:
    table = selection_table(policies(), "cautious_0.5").query("algorithm == 'bc'").head(1)
    head, _, row = (
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in selection_markdown(table.assign(score=-7.0, model_error=0.3)).splitlines()
    )
    at = head.index("score")
    assert head[at : at + 3] == ["score", "gain, ensemble", "±"]
    assert row[at : at + 3] == ["-7.0", "1.0", "0.5"], "0.5 of the policy's 0.3, the log's 0.4"


def test_judges_are_measured_where_true_returns_are_known() -> None:
    known = policies()
    known.loc[known["dataset"] == "first", "true_return"] = np.nan
    judges = judge_table(known, {"second": -10.0}, {"second": "operators"})
    assert set(judges["dataset"]) == {"second"}
    assert list(judges["score"]) == list(SCORES)
    assert (judges["policies"] == 6).all()
    assert (judges["group"] == "operators").all()
    assert judges.set_index("score").loc["model", "regret_1"] == 0.0
    assert judge_table(known.assign(true_return=np.nan), {}, {}).empty
