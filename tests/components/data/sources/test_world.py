"""The dataset of the 2-D world: sizes, contents, card, the same bytes for the same seed."""

import math

import numpy as np
import pytest

from components.data.controllers.world import to_nearest
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.returns import window_returns
from components.data.sources.source import generate
from components.data.sources.world import WorldSpec
from components.environments.world.plane import SIDE, reward_at


def test_the_set_has_the_size_of_its_authors() -> None:
    spec = WorldSpec("world")
    dataset = generate(spec, seed=0)
    card = dataset.card
    assert (card.trajectories, card.steps, card.transitions) == (400, 25, 10_000)
    assert (card.history, card.discount, card.epsilon, card.environment) == (
        1, 0.99, 0.1, "proximity/World-v0",
    )  # fmt: skip
    assert dataset.truncated.sum() == 400
    assert not dataset.terminated.any()
    returns = window_returns(dataset.rewards.reshape(400, 25), 0.99, 25)
    assert card.first_window_return_mean == pytest.approx(returns.mean())


def test_it_logs_what_happened() -> None:
    dataset = generate(WorldSpec("world", episodes=50), seed=0)
    frames = dataset.frames.reshape(50, 26, 2)
    actions = dataset.actions.reshape(50, 25, 2)
    # positions are stored in single precision, and moved in double
    np.testing.assert_allclose(frames[:, 1:] - frames[:, :-1], actions, atol=2e-6)
    np.testing.assert_allclose(dataset.rewards.reshape(50, 25), reward_at(frames[:, 1:]), atol=2e-6)
    explored = generate(WorldSpec("world", epsilon=1.0, length=100), seed=0).frames
    assert (explored < 0.0).any()
    assert (explored > SIDE).any()


def test_one_action_in_ten_explores() -> None:
    dataset = generate(WorldSpec("world"), seed=0)
    before = dataset.frames[dataset.frame_rows()].astype(np.float64)
    wanted = to_nearest(before, WorldSpec("world").goals)
    explored = np.abs(dataset.actions - wanted).max(axis=1) > 1e-5  # of single precision
    assert explored.mean() == pytest.approx(0.1, abs=5 * math.sqrt(0.1 * 0.9 / 10_000))


def test_it_depends_on_name_and_seed_alone() -> None:
    first = generate(WorldSpec("world"), seed=0).card.digest
    assert generate(WorldSpec("world"), seed=0, threads=2).card.digest == first
    assert generate(WorldSpec("world"), seed=1).card.digest != first
    assert generate(WorldSpec("other"), seed=0).card.digest != first


def test_models_learn_positions_and_reward() -> None:
    dataset = generate(WorldSpec("world", episodes=3), seed=0)
    dynamics = DynamicsSpecification.of_card(dataset.card)
    assert dynamics.features == ("step_x", "step_y", "x", "y", "reward")
    frames = model_frames(dataset, dynamics)
    np.testing.assert_array_equal(frames[1:26, :2], dataset.actions[:25])
    np.testing.assert_array_equal(frames[1:26, 4], dataset.rewards[:25])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goals": ()}, "goals is empty"),
        ({"epsilon": 1.5}, "epsilon is 1.5"),
        ({"episodes": 1}, "make no dataset"),
        ({"length": 0}, "make no dataset"),
        ({"discount": 0.0}, "discount is 0.0"),
    ],
)
def test_values_outside_their_range_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldSpec("world", **changes)
