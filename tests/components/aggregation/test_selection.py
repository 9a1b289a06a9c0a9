"""How well estimates rank policies, on tables made by hand."""

import numpy as np
import pandas as pd
import pytest

from components.aggregation.selection import SCORES, chosen_blind, quality, scored

TRUE = [-10.0, -9.0, -8.0, -11.5, -30.0]


def table(model: list[float], **columns: list[float]) -> pd.DataFrame:
    """Five policies beside a behaviour policy of which the model says -10."""
    usual = {"model": -10.0, "model_least": -11.0, "fitted_q": -10.0, "distance": 0, "outside": 0.1}
    made = {
        "model": model,
        "model_least": [value - 1 for value in model],
        "fitted_q": model,
        "distance": [0.0, 0.1, 0.2, 0.3, 1.0],
        "outside": [0.1, 0.1, 0.1, 0.1, 0.9],
        "promised": [0.0, 1.0, 2.0, -1.0, 5.0],
        "true_return": TRUE,
    } | columns
    return pd.DataFrame(made).assign(**{f"{name}_usual": value for name, value in usual.items()})


def of_score(found: pd.DataFrame, name: str) -> pd.Series:
    return found.set_index("score").loc[name]


def test_a_perfect_judge_has_no_regret_and_catches_everything() -> None:
    found = of_score(quality(scored(table(TRUE)), -10.0), "model")
    assert found.spearman == pytest.approx(1.0)
    assert found.regret_1 == found.regret_5 == 0.0
    assert found.caught == found.exploits_caught == found.cleared == 1.0


def test_an_exploited_model_is_found_out_by_the_support() -> None:
    # The model promises most for the policy that is worst.
    rows = quality(scored(table([-10.0, -9.5, -9.0, -11.0, -5.0])), -10.0)
    model, cautious = of_score(rows, "model"), of_score(rows, "cautious_1")
    assert model.regret_1 == 22.0
    assert model.relative_regret == 0.5  # the range of returns is 22, and the second regret 0
    assert model.regret_5 == 0.0  # all five are taken
    assert model.exploits_caught == 0.0
    assert model.caught == 0.5
    # 5 gained less 10 * 0.8 for straying
    assert cautious.exploits_caught == 1.0
    assert cautious.regret_1 == 0.0


def test_shares_of_nothing_are_not_numbers() -> None:
    found = quality(scored(table(TRUE)), -40.0)
    assert found["caught"].isna().all()
    assert found["exploits_caught"].isna().all()
    assert np.isfinite(found["cleared"]).all()


def test_the_score_for_a_group_is_chosen_on_the_others() -> None:
    rows = [
        {"group": group, "score": score, "relative_regret": regret}
        for group, regrets in {"bad": (0.9, 0.1), "good": (0.0, 0.5), "fair": (0.1, 0.3)}.items()
        for score, regret in zip(("model", "fitted_q"), regrets, strict=True)
    ]
    chosen = chosen_blind(pd.DataFrame(rows), ["bad", "good"])
    assert chosen == {"bad": "model", "good": "fitted_q"}


def test_every_score_of_the_behaviour_policy_itself_is_zero() -> None:
    same = table(TRUE)
    for name in ("model", "model_least", "fitted_q", "distance", "outside"):
        same[name] = same[f"{name}_usual"]
    for name, score in SCORES.items():
        assert (score(same) == 0).all(), name
