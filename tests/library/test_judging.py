"""Judging by the library: the estimates of a sweep, in a table."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import proximity_bench as pb
from tests.components.synthetic import make_log
from tests.library.test_training import LOG as LEARNED
from tests.library.test_training import MODELS, trained

LOG = make_log(episodes=8)
SMALL: dict[str, Any] = {
    "models": {name: MODELS[name] for name in ("behaviour_policy", "recurrent_ensemble")},
    "proximity_step": 0.5,
    "starts": 4,
    "visited": 20,
    "updates": 10,
    "hidden": [8],
    "batch": 8,
    "progress": False,
}


def test_a_log_is_divided_by_whole_episodes() -> None:
    learned, held_out = pb.split(LOG, 0.25)
    assert (learned.episodes, held_out.episodes) == (6, 2)
    np.testing.assert_array_equal(np.concatenate([learned.actions, held_out.actions]), LOG.actions)
    for share in (0.01, 0.99):  # models need two episodes of both
        assert {part.episodes for part in pb.split(LOG, share)} == {2, 6}
    with pytest.raises(ValueError, match="between 0 and 1"):
        pb.split(LOG, 1.0)


def test_policies_are_judged_best_first() -> None:
    lion, bc = trained("lion", snapshots=2), trained("bc", snapshots=2)
    table = pb.judge([lion, bc], LOG, **SMALL)
    assert len(table) == 3 + 1
    assert set(table["algorithm"]) == {"lion", "bc"}
    assert (table["step"] == 6).all()
    assert table["score"].is_monotonic_decreasing
    assert np.isfinite(table.drop(columns=["algorithm", "proximity"])).all(axis=None)
    assert table.loc[table["algorithm"] == "bc", "proximity"].isna().all()
    alone = pb.judge(bc, LOG, **SMALL).iloc[0]
    beside = table[table["algorithm"] == "bc"].iloc[0]
    # Products of other sizes are rounded otherwise.
    assert alone["fitted_q"] == pytest.approx(beside["fitted_q"], rel=1e-3)
    assert alone["model"] == pytest.approx(beside["model"], rel=1e-3)


def test_a_log_that_a_policy_has_learned_from_is_warned_of() -> None:
    with pytest.warns(UserWarning, match="has learned from this very log"):
        pb.judge(trained("bc", snapshots=1), LEARNED, **SMALL)


def test_without_dynamics_on_the_card_critics_judge_alone() -> None:
    bare = replace(LOG, card=replace(LOG.card, dynamics={}))
    table = pb.judge(trained("bc", snapshots=1), bare, **SMALL)
    assert np.isnan(table["model"]).all()
    assert np.isfinite(table["score"]).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"updatez": 3}, "updatez"),
        ({"replicas": 0}, "replicas"),
        ({"models": {"recurrent_ensembl": {}}}, "recurrent_ensembl"),
        ({"device": "tpu"}, "device='tpu' is unknown"),
    ],
)
def test_mistakes_end_in_one_sentence(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pb.judge(trained("bc", snapshots=1), LOG, **(SMALL | wrong))


@pytest.mark.parametrize("policies", [[], "furnace-policy"])
def test_something_must_be_judged(policies: Any) -> None:
    with pytest.raises(ValueError, match="Nothing to judge; give a policy"):
        pb.judge(policies, LOG, **SMALL)


def test_a_log_of_another_plant_is_refused() -> None:
    policy = trained("bc", snapshots=1)
    names = ("pressure", *LOG.card.frame_features[1:])
    other = replace(LOG, card=replace(LOG.card, frame_features=names, dynamics={}))
    with pytest.raises(ValueError, match="judge it by a log of its own plant"):
        pb.judge(policy, other, **SMALL)
