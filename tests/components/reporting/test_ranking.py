"""Tables and figures of a ranking, of logs that reproduce the published order."""

import dataclasses
import math

import pandas as pd
import pytest

from components.data.indicators import LogFacts
from components.reporting.ranking import (
    Measured,
    clip_table,
    correlation_table,
    markdown,
    ranking_table,
    thesis_ranks,
    true_improvements,
)
from components.reporting.ranking_figures import clip_figure, ranking_figure


def measured(name: str, eri: float, eas: float, **changes: object) -> Measured:
    """A log of mean return 1 above a floor of -1, so that its ERI and its best return agree."""
    facts = LogFacts(
        name=name,
        environment="none",
        controller=name.partition("-")[0],
        epsilon=0.2,
        actions=("a",),
        episodes=20,
        windows=20,
        window=100,
        transitions=2000,
        return_mean=0.0,
        return_min=-0.5,
        return_max=eri,
        action_range=(0.5,),
    )
    values = {"facts": facts, "floor": -1.0, "eas": eas, "over_clips": {0.9: eas, 0.99: -eas}}
    return Measured(**(values | changes))  # type: ignore[arg-type]


def published() -> list[Measured]:
    """Logs whose indicators have the ranks of table 4.1, and an algorithm with its improvements."""
    return [
        measured(
            str(name),
            0.1 * (row.eri_rank + 1),
            0.1 * (row.eas_rank + 1),
            achieved={"moose": float(row.tri_rank)},
        )
        for name, row in thesis_ranks().iterrows()
    ]


def test_the_published_ranks_give_the_published_table() -> None:
    table = ranking_table(published(), "moose").set_index("dataset")
    for name in ("eri", "eas", "coi", "tri"):
        assert (table[f"{name}_rank"] == table[f"thesis_{name}_rank"]).all()
    assert table.index[0] == "bad-0.8"
    assert table.loc["bad-0.8", "coi_score"] == 38
    assert table["coi_rank"].tolist() == list(range(15, -1, -1))
    assert table.loc["bad-0.4", "eri"] == pytest.approx(1.5)
    assert table.loc["bad-0.4", "proximity_to"] == 0.3


def test_the_published_ranks_give_the_published_correlations() -> None:
    table = correlation_table(published()).set_index("target").round(2)
    everywhere, without = (0.91, 0.13, 0.75), (0.81, 0.83, 0.86)
    for target in (
        "true improvement by moose",
        "the thesis's true improvement",
        "thesis: its indicators and improvement",
    ):
        row = table.loc[target]
        assert (row["datasets"], row["datasets_without"]) == (16, 11)
        assert tuple(row[["eri", "eas", "coi"]]) == everywhere
        assert tuple(row[["eri_without", "eas_without", "coi_without"]]) == without
    same = table.loc["the same indicator in the thesis"]
    assert tuple(same[["eri", "eas", "coi"]]) == (1.0, 1.0, 1.0)


def test_logs_that_the_thesis_does_not_know() -> None:
    logs = [measured(name, i + 1.0, 3.0 - i) for i, name in enumerate(("x", "y", "z"))]
    table = ranking_table(logs, None)
    assert table.filter(like="thesis_").isna().all(axis=None)
    assert "tri" not in table
    assert table["dataset"].tolist() == ["z", "y", "x"]
    assert correlation_table(logs).empty
    # A result on one log alone is shown and gives no correlation.
    logs[1] = dataclasses.replace(logs[1], achieved={"bc": 1.0})
    assert true_improvements(logs)["bc"].to_dict() == {"y": pytest.approx(1.0)}
    table = ranking_table(logs, "bc").set_index("dataset")
    assert table.loc["y", "tri_rank"] == 0
    assert math.isnan(table.loc["x", "tri_rank"])
    assert correlation_table(logs).empty


def test_some_of_the_sixteen_are_ranked_among_themselves() -> None:
    chosen = [log for log in published() if log.name.startswith("optimized")]
    table = ranking_table(chosen, None).set_index("dataset")
    assert table["thesis_eri_rank"].to_dict() == table["eri_rank"].to_dict()
    assert sorted(table["thesis_tri_rank"]) == [0, 1, 2, 3, 4]


def test_a_single_log_is_ranked() -> None:
    table = ranking_table([measured("x", 1.0, 1.0)], None)
    assert table.loc[0, ["eri_rank", "eas_rank", "coi_rank"]].tolist() == [0, 0, 0]


def test_the_clip_table_says_what_the_clip_does_to_the_order() -> None:
    table = clip_table(published()).set_index("clip")
    assert table.loc[0.9, "spearman_chosen"] == pytest.approx(1.0)
    assert table.loc[0.99, "spearman_chosen"] == pytest.approx(-1.0)
    assert table.loc[0.99, "spearman_thesis"] == pytest.approx(-1.0)
    assert table.loc[0.9, "bad-0.0"] == pytest.approx(0.1)


def test_figures_show_every_log_that_has_a_value() -> None:
    logs = [*published(), measured("mine", 1.0, 2.0, generated=False)]
    left, right = ranking_figure(logs, "moose").axes
    assert len(left.texts) == 16, "mine has no true improvement"
    assert len(right.texts) == 16, "how random its actions are is not known"
    assert "TRI" in left.get_xlabel()
    left, right = ranking_figure(logs[-1:], None).axes
    assert [len(left.texts), len(right.texts)] == [1, 1]
    assert "EAS" in left.get_xlabel()
    upper, lower = clip_figure(logs, clip_table(logs), 0.9).axes
    assert [text.get_text() for text in upper.texts] == [log.name for log in logs]
    assert [label.get_text() for label in lower.get_xticklabels()] == ["0.9", "0.99"]


def test_markdown_is_aligned() -> None:
    table = pd.DataFrame({"dataset": ["a", "long"], "x": [1.234, math.nan]})
    assert markdown(table, {"x": 1}).splitlines() == [
        "| dataset |   x |",
        "| ------- | --: |",
        "| a       | 1.2 |",
        "| long    |     |",
    ]
