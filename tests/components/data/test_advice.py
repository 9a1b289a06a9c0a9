"""The sentence about what limits a log, and the first guess of the proximity."""

import dataclasses

import pytest

from components.data.advice import initial_proximities, limitation
from components.data.indicators import LogFacts

LOG = LogFacts(
    name="furnace",
    environment="none",
    controller="operators",
    epsilon=0.0,
    actions=("gas", "air"),
    episodes=40,
    windows=40,
    window=100,
    transitions=4000,
    return_mean=-60.0,
    return_min=-70.0,
    return_max=-50.0,
    action_range=(0.5, 0.6),
)


@pytest.mark.parametrize(
    ("changes", "eri", "eas", "says"),
    [
        ({}, 0.2, 0.8, "Nothing that these indicators see limits it."),
        (
            {"windows": 1},
            0.0,
            0.8,
            "Limited by few episodes (a single episode of 100 steps or more, so that ERI is 0 by "
            "definition).",
        ),
        ({"windows": 4}, 0.2, 0.8, "few episodes (4 episodes only of 100 steps or more, so that"),
        ({}, 0.004, 0.8, "a return that hardly varies (the best episode is 0.4 % above the mean"),
        (
            {"return_min": -50.0},
            0.0,
            0.8,
            "rewards that tell nothing (all episodes have the same return)",
        ),
        ({"action_range": (0.5, 0.01)}, 0.2, 0.8, "narrow actions (air uses less than 5 % of"),
        ({"action_range": (0.0, 0.0)}, 0.2, 0.8, "narrow actions (every action uses less than"),
        ({}, 0.2, 0.01, "no exploration (the state fixes the action"),
        ({}, 0.2, 0.3, "little exploration (EAS is 0.30)"),
    ],
)
def test_the_sentence(changes: dict[str, object], eri: float, eas: float, says: str) -> None:
    found = limitation(dataclasses.replace(LOG, **changes), eri, eas)  # type: ignore[arg-type]
    assert says in found
    assert found.count(".") <= 1 + says.count(".")
    assert found.endswith(".")


def test_everything_that_limits_is_named() -> None:
    poor = dataclasses.replace(LOG, windows=2, action_range=(0.0, 0.5))
    found = limitation(poor, 0.001, 0.02)
    parts = ["few episodes", "hardly varies", "narrow actions (gas", "no exploration"]
    assert [part in found for part in parts] == [True] * 4
    assert found.count("; and by ") == 3


@pytest.mark.parametrize(
    ("eas", "highest"), [(0.0, 0.0), (0.09, 0.0), (0.3, 0.15), (0.62, 0.3), (0.89, 0.4), (7.0, 1.0)]
)
def test_the_guess_grows_with_exploration(eas: float, highest: float) -> None:
    assert initial_proximities(eas) == (0.0, highest)
