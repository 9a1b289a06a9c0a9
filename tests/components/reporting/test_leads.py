"""Where judged policies lead: columns, sentences, and the table beside the log's own values."""

from dataclasses import replace

import pandas as pd
import pytest

from components.reporting.judged_page import judged_content
from components.reporting.leads import Lead, lead_table, leads_of, strays
from components.reporting.promises import promise
from tests.components.reporting.judged import NAN, log

SHARES = {f"held_{end}{usual}": 0.0 for end in ("low", "high") for usual in ("", "_usual")}


def test_a_column_that_leaves_the_log_by_more_than_a_tenth_is_named() -> None:
    leads = [
        Lead("level", 40.0, 140.0, 41.0, 69.0),
        Lead("temperature", 60.0, 79.3, 64.0, 78.0),
        Lead("pressure", 0.9, 1.3, 1.0, 2.0),
        Lead("constant", 3.0, 3.2, 3.0, 3.0),
    ]
    assert strays("lion", leads) == [
        "Beyond the judges' part of the log, lion is expected to lead level up to 140 (at most 69 "
        "there); temperature down to 60 (at least 64 there)."
    ]
    assert strays("lion", leads[2:]) == [], "by exactly a tenth, or hardly"
    assert "level to where it is not finite" in strays("lion", [replace(leads[0], high=NAN)])[0]


def test_a_column_at_which_the_ensemble_is_held_is_named() -> None:
    """As the level of a tank, that went to 140 while the log had at most 69."""
    level = Lead("level", 50.0, 69.0, 41.0, 69.0, held_high=0.85, held_high_usual=0.02)
    [said] = strays("lion", [level])
    assert said == (
        "Under lion the ensemble stops at the edge of the judges' part of the log: level at 69, "
        "the greatest that it knows, in 85% of the steps. It cannot tell what lies beyond, and "
        "the plant may go on there."
    )
    assert level.expected == "50 to 69, 85% at the greatest"
    assert strays("lion", [replace(level, held_high_usual=0.8)]) == [], "a sensor that saturates"
    low = replace(level, low=41.0, held_high=0.0, held_low=0.4)
    assert "level at 41, the least that it knows, in 40% of the steps" in strays("lion", [low])[0]


def test_seeds_stand_together_by_their_widest_ends() -> None:
    rows = [
        {"algorithm": name, "proximity": at, "feature": feature, "low": low, "high": high}
        for name, at, low, high in (("lion", 0.1, 1, 5), ("lion", 0.1, 2, 9), ("bc", NAN, 3, 4))
        for feature in ("level", "flow")
    ]
    leads = leads_of(pd.DataFrame(rows).assign(least=2.0, greatest=6.0, **SHARES))
    assert leads["lion", 0.1] == [Lead(name, 1.0, 9.0, 2.0, 6.0) for name in ("level", "flow")]
    assert leads["bc", None][0] == Lead("level", 3.0, 4.0, 2.0, 6.0)
    table = lead_table({"lion at λ 0.10": leads["lion", 0.1], "bc": leads["bc", None]})
    assert table.to_dict("records")[1] == {
        "column": "flow",
        "log": "2 to 6",
        "lion at λ 0.10": "1 to 9",
        "bc": "3 to 4",
    }
    assert leads_of(pd.DataFrame()) == {}


@pytest.mark.parametrize("known", [True, False])
def test_a_promise_shows_where_its_beginning_and_the_judges_choice_lead(known: bool) -> None:
    leads = [Lead("level", 50.0, 140.0, 41.0, 69.0)]
    choices = [replace(choice, leads=leads if known else ()) for choice in log().choices]
    told = promise(log(choices=choices))
    shown = ["column", "log", "lion at λ 0.10", "td3_bc"] if known else []
    assert list(told.leads) == shown
    said = [
        warning for warning in told.warnings if "is expected to lead level up to 140" in warning
    ]
    assert len(said) == (2 if known else 0), "of a judgement of before nothing is known"
    [content] = judged_content([log(choices=choices)])
    assert (content["leads"] is not None) == known
