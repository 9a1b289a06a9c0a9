"""EAS: known spreads are found, clips are lanes of their own, degenerate logs have a value."""

import dataclasses
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.core.random_streams import lane_generator, lane_key
from components.data.dataset import OfflineDataset
from components.models import supervised
from components.models.action_stochasticity import (
    LOG_SPREAD_RANGE,
    ActionStochasticity,
    StochasticityConfig,
    fit_action_stochasticity,
)
from components.models.supervised import StackedFit
from tests.components.interruption import killed_at, save_always
from tests.components.synthetic import CPU, make_log, relabelled

SMALL: dict[str, Any] = {
    "clips": (0.9,), "hidden": (16,), "updates": 150, "batch": 64, "learning_rate": 1e-2,
}  # fmt: skip


def fit(log: OfflineDataset, checkpoint: Path | None = None, **options: Any) -> ActionStochasticity:
    config = StochasticityConfig(**(SMALL | options))
    return fit_action_stochasticity(log, config, lane_key("spread"), CPU, checkpoint)


def shaken(spread: float, episodes: int = 20, steps: int = 50) -> OfflineDataset:
    """The log of a steady hand that shakes with a deviation before the tanh."""
    log = make_log(episodes=episodes, steps=steps)
    noise = lane_generator(7).normal(size=log.actions.shape)
    return relabelled(log, actions=np.tanh(0.2 + spread * noise).astype(np.float32))


@pytest.mark.parametrize("spread", [0.1, 0.4])
def test_a_known_spread_is_found(spread: float) -> None:
    # 0.9 clips at 1.47 before the tanh, three deviations from the mean. 1000 steps of three
    # actions tell a deviation to 1.3 %; the rest is the fit of 400 updates.
    found = fit(shaken(spread), updates=400)
    assert found.eas == pytest.approx(spread, rel=0.1)
    assert all(value == pytest.approx(spread, rel=0.15) for value in found.spread[0])


def test_clips_are_lanes_that_do_not_disturb_one_another() -> None:
    log = make_log(episodes=8, steps=40, explore=1.0)
    together = fit(log, clips=(0.99, 0.5), updates=40)
    assert together.clips == (0.5, 0.9, 0.99)
    assert list(together.expected) == [0.5, 0.9, 0.99]
    alone = fit(log, updates=40)
    # One lane or three are summed in different orders, in float32 over 40 updates.
    assert together.eas == pytest.approx(alone.eas, rel=1e-3)
    # Uniform actions: the weaker the clip, the farther out the inverse tanh.
    assert list(together.expected.values()) == sorted(together.expected.values())
    assert together.expected[0.99] > 1.2 * together.expected[0.5]


def test_more_exploration_is_more_stochastic() -> None:
    found = [fit(make_log(episodes=20, explore=epsilon)).eas for epsilon in (0.0, 0.3, 1.0)]
    assert found == sorted(found)
    assert found[2] > 2.0 * found[0]


def degenerate(kind: str) -> OfflineDataset:
    log = make_log(episodes=1 if kind == "one episode" else 4, steps=30)
    if kind == "constant action":
        return relabelled(log, actions=np.full_like(log.actions, 1.0))
    if kind == "constant state":
        return relabelled(log, frames=np.full_like(log.frames, 3.0))
    if kind == "constant reward":
        return relabelled(log, rewards=np.zeros_like(log.rewards))
    return log


@pytest.mark.parametrize(
    "kind", ["one episode", "constant action", "constant state", "constant reward"]
)
def test_degenerate_logs_have_a_value(kind: str) -> None:
    found = fit(degenerate(kind), updates=60)
    assert np.exp(LOG_SPREAD_RANGE[0]) <= found.eas < np.exp(LOG_SPREAD_RANGE[1])
    if kind == "constant action":
        assert found.eas < 0.15


def test_a_single_transition_is_refused() -> None:
    log = make_log(episodes=1, steps=1)
    with pytest.raises(ValueError, match="toy has a single transition, which has no spread"):
        fit(log)
    assert fit(make_log(episodes=1, steps=2), updates=2).eas > 0.0


def test_a_killed_fit_continues_to_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, options = make_log(episodes=4, steps=30), {"updates": 30, "clips": (0.9, 0.99)}
    expected = fit(log, **options)
    save_always(monkeypatch, supervised)
    found = killed_at(
        [17, 25], StackedFit, lambda path: fit(log, path, **options), tmp_path / "s", monkeypatch
    )
    assert found == expected


def test_the_record_survives_json() -> None:
    found = fit(make_log(episodes=3, steps=20), updates=3, clips=(0.5,))
    assert ActionStochasticity.of_record(json.loads(json.dumps(asdict(found)))) == found


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"clip": 1.0}, r"clip and clips must lie in \(0, 1\)"),
        ({"clips": (0.5, 0.0)}, r"clip and clips must lie in \(0, 1\)"),
        ({"updates": 0}, "must be at least 1"),
        ({"hidden": (0,)}, "must be at least 1"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
    ],
)
def test_settings_outside_their_range(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(StochasticityConfig(), **options)
