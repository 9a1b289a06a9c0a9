"""Gymnasium's view of the 2-D world: its checkers, seeding, options and vectors."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from components.environments.systems import WORLD


def make_vec(copies: int, **parameters: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(WORLD.id, num_envs=copies, **parameters)


def test_gymnasium_accepts_the_environment() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(WORLD.id).unwrapped)


def test_a_single_agent_is_seeded_and_can_be_put_anywhere() -> None:
    environment = gym.make(WORLD.id)
    first = environment.reset(seed=4)[0]
    assert first.shape == (2,)
    assert first.dtype == np.float32
    assert not np.array_equal(first, environment.reset()[0])
    assert np.array_equal(first, environment.reset(seed=4)[0])
    placed = environment.reset(options={"start": {"x": -2.0, "y": 30.0}})[0]
    assert placed.tolist() == [-2.0, 30.0]
    assert placed in environment.observation_space


def test_agents_of_a_vector_behave_as_single_ones() -> None:
    single, several = gym.make(WORLD.id), make_vec(1)
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 1, 2)).astype(np.float32)
    np.testing.assert_array_equal(single.reset(seed=3)[0], several.reset(seed=3)[0][0])
    for action in actions:
        observation, reward, *_ = single.step(action[0])
        observations, rewards, *_ = several.step(action)
        np.testing.assert_array_equal(observation, observations[0])
        assert reward == rewards[0]


def test_a_vector_meets_gymnasiums_conventions() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = RecordEpisodeStatistics(make_vec(3, max_episode_steps=4))
        observations, info = environment.reset(seed=0, options={"start": {"x": 5.0}})
        assert info == {}
        for step in range(4):
            result = environment.step(np.tile(np.float32([1.0, 0.0]), (3, 1)))
            observations, _, terminated, truncated, info = result
            assert observations in environment.observation_space
            assert observations[:, 0].tolist() == [6.0 + step] * 3
            assert truncated.tolist() == [step == 3] * 3
            assert not terminated.any()
        assert info["episode"]["l"].tolist() == [4, 4, 4]
        started = environment.step(environment.action_space.sample())[0]
        assert (started <= 10.0).all()
        environment.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_it_is_drawn_elsewhere() -> None:
    for make in (gym.make, gym.make_vec):
        with pytest.raises(ValueError, match="does not exist"):
            make(WORLD.id, render_mode="human")
