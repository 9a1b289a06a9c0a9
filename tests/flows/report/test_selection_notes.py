"""What the report says about judges whose datasets come from several controllers."""

import pandas as pd

from flows.report.selection import _blind


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
