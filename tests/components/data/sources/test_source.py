"""Sources of datasets: their kinds; industrial industrial ones: cards, streams, performance."""

import dataclasses
import math

import numpy as np
import pytest

from components.data.controllers.industrial import CONTROLLERS
from components.data.history import gather_history
from components.data.returns import window_returns
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.source import DatasetSource, generate, source_kind
from components.data.sources.stored_log import StoredLog
from components.data.sources.world import WorldSpec


@pytest.mark.parametrize(
    "source",
    [
        IndustrialSpec("bad-0.2", "bad", 0.2),
        RobotSpec("hopper", "hopper"),
        StoredLog("mine", ""),
        WorldSpec("world"),
    ],
)
def test_every_source_is_known_by_its_fields_alone(source: DatasetSource) -> None:
    assert source_kind(source.identity)(**source.identity) == source


@pytest.mark.parametrize(
    ("name", "published"), [("bad-0.0", -326.8), ("mediocre-0.0", -78.3), ("optimized-0.0", -59.7)]
)
def test_performance_on_the_card(name: str, published: float) -> None:
    spec = IndustrialSpec(name, name.split("-")[0], 0.0, steps=150)
    dataset = generate(spec, seed=0)
    card = dataset.card
    returns = window_returns(dataset.rewards.reshape(100, 150), 0.97, 100)
    # five standard errors of a mean of 100 episodes, and half of the last printed digit
    tolerance = 5.0 * returns[:, 0].std() / math.sqrt(100) + 0.05
    assert card.first_window_return_mean == pytest.approx(published, abs=tolerance)
    assert card.first_window_return_min == pytest.approx(returns[:, 0].min())
    assert card.first_window_return_max == pytest.approx(returns[:, 0].max())
    assert card.all_windows_return_mean == pytest.approx(returns.mean())
    assert card.return_steps == 100


def test_short_trajectories_say_so_on_their_card() -> None:
    card = generate(IndustrialSpec("bad-0.2", "bad", 0.2, trajectories=2, steps=7), 0).card
    assert (card.return_steps, card.steps, card.trajectories) == (7, 7, 2)


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_stored_actions_are_what_the_controller_does_on_stored_frames(name: str) -> None:
    spec = IndustrialSpec(f"{name}-0.0", name, 0.0, trajectories=4, steps=200)
    dataset = generate(spec, seed=3)
    histories = gather_history(dataset.frames, dataset.frame_rows(), dataset.first_rows(), 30)
    wanted = CONTROLLERS[name](histories.reshape(-1, 30, 6).astype(np.float64))
    # the controller saw the frames before they were rounded to float32
    np.testing.assert_allclose(dataset.actions, wanted, atol=2e-5)


def test_exploration_happens_at_the_named_rate() -> None:
    dataset = generate(IndustrialSpec("bad-0.4", "bad", 0.4, trajectories=20, steps=500), 0)
    wanted = np.clip(100.0 - dataset.frames[dataset.frame_rows(), 1:4], -1.0, 1.0)
    explored = np.abs(dataset.actions - wanted).max(axis=1) > 1e-4
    # five standard errors in 10,000 steps
    assert explored.mean() == pytest.approx(0.4, abs=5.0 * 0.49 / 100.0)


def test_stream_depends_on_name_and_seed_alone() -> None:
    spec = IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=2, steps=50)
    digest = generate(spec, 0).card.digest
    np.random.seed(7)  # noqa: NPY002 - the global state must not matter
    assert generate(spec, 0).card.digest == digest
    assert generate(spec, 1).card.digest != digest
    renamed = generate(dataclasses.replace(spec, name="another"), 0)
    assert renamed.card.digest != digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controller": "good"}, "known are bad, mediocre, optimized"),
        ({"epsilon": 1.5}, "from 0 to 1"),
        ({"setpoint": 101.0}, "from 0 to 100"),
        ({"trajectories": 0}, "at least 1"),
        ({"discount": 0.0}, "above 0"),
    ],
)
def test_impossible_specifications_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        IndustrialSpec(**{"name": "bad-0.0", "controller": "bad", "epsilon": 0.0, **change})
    with pytest.raises(ValueError, match="seed is -1"):
        generate(IndustrialSpec("bad-0.0", "bad", 0.0), -1)
