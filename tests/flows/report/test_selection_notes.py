"""What the report says about judges whose datasets come from several controllers."""

from dataclasses import replace

import numpy as np
import pandas as pd

from components.data.card import DatasetCard
from flows.report.selection import _blind, doubts
from tests.components.synthetic import make_log


def test_the_choice_for_a_controllers_logs_is_blind_to_them() -> None:
    rows = [
        {"group": group, "score": score, "relative_regret": regret}
        for group, regrets in {"bad": (0.5, 0.1), "good": (0.0, 0.3)}.items()
        for score, regret in zip(("model", "fitted_q"), regrets, strict=True)
    ]
    judges = pd.DataFrame(rows)
    blank, said = _blind(judges)
    assert blank == ""
    assert said.endswith("bad: model (0.50); good: fitted_q (0.30).")
    assert _blind(judges[judges["group"] == "bad"]) == []


def judged(card: DatasetCard, model: float, fitted_q: float) -> list[str]:
    table = pd.DataFrame(
        {"dataset": [card.name], "model_usual": [model], "fitted_q_usual": [fitted_q]}
    )
    return doubts(table, [card])


def test_judges_that_contradict_the_log_itself_are_doubted() -> None:
    card = replace(make_log().card, first_window_return_min=-40.0, first_window_return_max=-26.0)
    assert judged(card, -30.0, -26.0) == []
    assert judged(card, np.nan, -30.0) == []  # no ensemble
    [said] = judged(card, -24.0, -23.7)
    assert "-24.0 by the ensemble and -23.7 by the critics" in said
    assert "between -40.0 and -26.0" in said
    assert doubts(pd.DataFrame({"dataset": ["other"]}), [card]) == []
