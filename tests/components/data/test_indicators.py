"""ERI and the ranks on logs that are small enough to compute by hand."""

import dataclasses
import json
import math
from dataclasses import asdict

import numpy as np
import pytest

from components.data.dataset import OfflineDataset
from components.data.indicators import (
    RETURN_FLOORS,
    LogFacts,
    combined_ranks,
    combined_scores,
    expected_return_improvement,
    log_facts,
    ranks,
    return_floor,
    spearman,
    true_return_improvement,
)
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.reporting.ranking import thesis_ranks
from tests.components.synthetic import make_log, relabelled


def three_episodes(*returns: float, **changes: object) -> OfflineDataset:
    """A log of episodes of four steps whose first three rewards, undiscounted, have these sums."""
    log = make_log(episodes=len(returns), steps=4, history=2)
    rewards = np.array([[0.25 * r, 0.5 * r, 0.25 * r, 1e6] for r in returns], dtype=np.float32)
    card = dataclasses.replace(log.card, discount=1.0, return_steps=3, **changes)
    return relabelled(dataclasses.replace(log, card=card), rewards=rewards.reshape(-1))


def test_eri_by_hand() -> None:
    facts = log_facts(three_episodes(-10.0, -20.0, -60.0))
    assert (facts.episodes, facts.windows, facts.transitions) == (3, 3, 12)
    assert (facts.return_mean, facts.return_max) == (-30.0, -10.0)
    # 20 above a mean that is 70 above the floor
    assert expected_return_improvement(facts, -100.0) == pytest.approx(20.0 / 70.0)
    assert true_return_improvement(-65.0, facts, -100.0) == pytest.approx(-0.5)
    # Without a floor the least return is one: 20 above a mean that is 30 above it.
    assert expected_return_improvement(facts, return_floor(facts)) == pytest.approx(20.0 / 30.0)


def test_returns_are_those_of_the_cards_window_and_discount() -> None:
    log = three_episodes(8.0, 4.0)
    card = dataclasses.replace(log.card, discount=0.5, return_steps=2)
    facts = log_facts(dataclasses.replace(log, card=card))
    assert facts.return_max == 0.25 * 8.0 + 0.5 * 0.5 * 8.0
    assert facts.window == 2


def test_floors() -> None:
    assert set(RETURN_FLOORS) == {INDUSTRIAL_BENCHMARK_ID}
    machine = {"environment": INDUSTRIAL_BENCHMARK_ID}
    facts = log_facts(three_episodes(-80.0, -70.0, **machine))
    assert return_floor(facts) == -350.0
    assert return_floor(facts, -90.0) == -90.0
    # By another discount the machine's returns may be lower than the thesis's floor.
    assert return_floor(log_facts(three_episodes(-960.0, -80.0, **machine))) == -960.0
    with pytest.raises(ValueError, match=r"toy has returns down to -80, below the floor of -75; "):
        return_floor(facts, -75.0)


@pytest.mark.parametrize("returns", [(-7.0,), (-7.0, -7.0, -7.0)])
def test_one_episode_and_equal_returns_promise_nothing(returns: tuple[float, ...]) -> None:
    facts = log_facts(three_episodes(*returns))
    for floor in (return_floor(facts), -100.0):
        assert expected_return_improvement(facts, floor) == 0.0


def test_no_whole_window_is_refused() -> None:
    log = three_episodes(-1.0, -2.0)
    card = dataclasses.replace(log.card, return_steps=5)
    with pytest.raises(ValueError, match="no episode has a window of 5 steps"):
        log_facts(dataclasses.replace(log, card=card))


def test_ranges_of_actions() -> None:
    log = make_log(episodes=5, steps=41)
    column = np.linspace(-1.0, 1.0, log.transitions)
    actions = np.stack([column, 0.1 * column, np.full_like(column, 0.3)], axis=1)
    found = log_facts(relabelled(log, actions=actions.astype(np.float32))).action_range
    assert found == pytest.approx((0.9, 0.09, 0.0), abs=1e-6)


def test_facts_survive_json() -> None:
    facts = log_facts(make_log(episodes=3, steps=20))
    assert LogFacts.of_record(json.loads(json.dumps(asdict(facts)))) == facts


def test_ranks_share_the_lower_place() -> None:
    assert ranks([5.0, 1.0, 5.0, 7.0]).tolist() == [1, 0, 1, 3]


def test_published_coi_follows_from_published_eri_and_eas() -> None:
    """Among them three pairs of equal sums, which only the order by EAS puts as published."""
    table = thesis_ranks()
    eri, eas = table["eri_rank"].tolist(), table["eas_rank"].tolist()
    scores = dict(zip(table.index, combined_scores(eri, eas).tolist(), strict=True))
    assert scores["bad-0.2"] == scores["bad-0.4"] == 33
    assert scores["bad-0.8"] == 38
    assert len(set(scores.values())) == 13
    assert combined_ranks(eri, eas).tolist() == table["coi_rank"].tolist()


def test_spearman() -> None:
    assert spearman([1.0, 2.0, 9.0], [10.0, 20.0, 30.0]) == pytest.approx(1.0)
    assert spearman([1.0, 2.0, 9.0], [3.0, 2.0, 1.0]) == pytest.approx(-1.0)
    # 1 - 6 sum d^2 / (n (n^2 - 1)) with d = 0, 1, -1, 0
    assert spearman([1.0, 2.0, 3.0, 4.0], [1.0, 3.0, 2.0, 4.0]) == pytest.approx(1 - 6 * 2 / 60)
    # Equal values have their mean rank: Pearson's correlation of (0, 1.5, 1.5, 3) and (0, 1, 2, 3).
    assert spearman([1.0, 2.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]) == pytest.approx(
        np.corrcoef([0, 1.5, 1.5, 3], [0, 1, 2, 3])[0, 1]
    )
    assert math.isnan(spearman([1.0, 2.0], [1.0, 2.0]))
    assert math.isnan(spearman([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]))


def test_published_correlations_follow_from_published_ranks() -> None:
    table = thesis_ranks()
    plain = table[~table.index.str.startswith("bad")]
    for rows, printed in ((table, (0.91, 0.13, 0.75)), (plain, (0.81, 0.83, 0.86))):
        found = [spearman(rows[f"{name}_rank"], rows["tri_rank"]) for name in ("eri", "eas", "coi")]
        assert [round(value, 2) for value in found] == list(printed)
