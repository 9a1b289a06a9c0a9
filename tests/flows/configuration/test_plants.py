"""Settings that follow from the card of a log of somebody else's."""

from dataclasses import replace

import pytest

from components.algorithms import ALGORITHMS
from flows.configuration.plants import settings_of_log
from proximity_bench.training import _settings
from tests.components.synthetic import make_log

PLANT = replace(make_log().card, environment="")


def test_learners_value_the_future_as_the_returns_on_the_card_do() -> None:
    found = settings_of_log(replace(PLANT, discount=0.9))
    assert found["domain"] == "plant"
    with_a_discount = {n for n, a in ALGORITHMS.items() if hasattr(a.config(), "discount")}
    assert set(found["algorithm"]) == with_a_discount
    assert found["algorithm"]["td3_bc"] == {"discount": 0.9}
    assert found["algorithm"]["moose"] == {"discount": 0.9, "penalty_discount": 0.9}


def test_what_is_the_default_already_is_not_said() -> None:
    assert settings_of_log(replace(PLANT, discount=0.97)) == {"domain": "plant"}
    registered = replace(PLANT, environment="proximity/IndustrialBenchmark-v0", discount=0.9)
    assert settings_of_log(registered) == {}


@pytest.mark.parametrize(("given", "wanted"), [({}, 0.9), ({"discount": 0.5}, 0.5)])
def test_trainings_of_the_library_follow_and_what_is_given_wins(
    given: dict[str, float], wanted: float
) -> None:
    log = make_log(discount=0.9, episodes=8, steps=100)
    log = replace(log, card=replace(log.card, environment=""))
    chosen = _settings(log, "td3_bc", 0, {}, 1, given)
    assert chosen.algorithm_on("toy", "td3_bc").discount == wanted
