"""Which cells stand beside the thesis's values, and with which footnotes."""

from types import SimpleNamespace
from typing import Any

import pytest

from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node
from flows.planning.benchmark import benchmark_plan
from flows.report.comparison import comparable_behaviour, compare


def cells(*words: str) -> list[Node]:
    return benchmark_plan(load_settings(words)).by_component()["aggregation"]


ONE = ("datasets=[bad-0.4]", "algorithms=[ddpg,td3_bc,lion]")


def test_the_paper_profile_is_the_thesis() -> None:
    found = compare(cells("profile=paper", *ONE))
    assert {a: t.marks for (_, a), t in found.thesis.items()} == {"ddpg": "¹", "td3_bc": ""}
    assert found.thesis["bad-0.4", "ddpg"].value == -383.0
    assert "0.99" in found.footnotes["¹"]
    assert not found.notes
    assert not any(found.differences.values())


def test_reduced_budgets_have_a_footnote_that_names_them() -> None:
    found = compare(cells("profile=quick", *ONE, "seeds=[0,1,2]"))
    assert {a: t.marks for (_, a), t in found.thesis.items()} == {"ddpg": "¹²", "td3_bc": "²"}
    assert found.footnotes["²"] == (
        "the thesis's full budgets; here 3 of 5 seeds, ddpg 3,000 of 10,000 updates, td3_bc 800 of "
        "10,000 updates."
    )
    changed = {str(difference) for difference in found.differences["bad-0.4", "lion"]}
    assert {"lion 70 of 1,000 updates", "lion 0.001 of 0.0003 learning_rate"} <= changed


def test_an_option_that_was_taken_differs_from_the_thesis() -> None:
    words = ("profile=paper", "datasets=[bad-0.4]", "algorithms=[lion]")
    found = compare(cells(*words, "algorithm.lion.return_scale=50"))
    [difference] = found.differences["bad-0.4", "lion"]
    assert (difference.setting, difference.here, difference.thesis) == ("return_scale", 50.0, None)


@pytest.mark.parametrize("word", ["evaluation.horizon=20", "data.steps=500", "data.seed=1"])
def test_other_episodes_are_not_comparable_and_other_logs_only_differ(word: str) -> None:
    found = compare(cells("profile=paper", *ONE, word))
    if word.startswith("evaluation"):
        assert not found.thesis
        assert "returns of 20 steps with the discount 0.97" in found.notes[0]
    else:
        assert found.thesis
        assert not found.notes
        name = word.partition("=")[0].removeprefix("data.")
        assert any(d.setting.endswith(name) for d in found.differences["bad-0.4", "td3_bc"])


def test_returns_counted_as_the_thesis_prints_them_stand_beside_it_without_a_mark() -> None:
    found = compare(cells("profile=paper", *ONE, "evaluation.discount=0.99"))
    assert {a: (t.value, t.marks) for (_, a), t in found.thesis.items()} == {"ddpg": (-383.0, "")}
    assert not found.thesis["bad-0.4", "ddpg"].other_discount
    assert "100 steps with the discount 0.99" in found.notes[0]  # TD3+BC's is not
    usual = {n.key for n in cells("profile=paper", *ONE)}
    assert usual == {n.key for n in cells("profile=paper", *ONE, "evaluation.discount=null")}


def test_logs_that_are_divided_for_judges_are_compared_as_whole_logs() -> None:
    found = compare(cells("profile=paper", *ONE, "judging.policies=all", "data.seed=3"))
    said = {d.setting: (d.here, d.thesis) for d in found.differences["bad-0.4", "td3_bc"]}
    held_out = load_settings(["profile=paper"]).judging.held_out
    assert said == {"share held out for judges": (held_out, 0.0), "data.seed": (3, 0)}
    assert found.thesis["bad-0.4", "td3_bc"].value == -230.0


def test_robots_are_a_hint_and_own_logs_have_no_counterpart() -> None:
    found = compare(cells("profile=paper", "datasets=[hopper]", "algorithms=[td3_bc]"))
    [value] = found.thesis.values()
    assert value.marks == "³"
    [cell] = cells("profile=paper", "datasets=[bad-0.4]", "algorithms=[bc]")
    renamed = Node("aggregation", "a", "m:f", 1, cell.config | {"dataset": "mine"}, cell.inputs)
    assert compare([renamed]).differences == {}


def test_behaviour_is_shown_where_its_return_is_counted_alike() -> None:
    def card(**values: Any) -> Any:
        usual = {"name": "bad-0.4", "return_steps": 100, "discount": 0.97}
        return SimpleNamespace(**(usual | values), first_window_return_mean=-214.0)

    paper, smoke = (cells(f"profile={name}", *ONE) for name in ("paper", "smoke"))
    assert comparable_behaviour(card(), paper) == -214.0
    assert comparable_behaviour(card(), smoke) is None
    assert comparable_behaviour(card(discount=0.99), paper) is None
    assert comparable_behaviour(card(name="bad-0.6"), smoke) == -214.0  # which has no cells
