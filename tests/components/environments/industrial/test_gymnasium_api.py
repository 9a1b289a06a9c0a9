"""Gymnasium's view of the machine: its checkers, seeding, options and autoreset."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from components.environments import INDUSTRIAL_BENCHMARK_ID


def make_vec(copies: int, **parameters: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(INDUSTRIAL_BENCHMARK_ID, num_envs=copies, **parameters)


@pytest.mark.parametrize("parameters", [{}, {"setpoint": 30.0, "history": 1}])
def test_gymnasium_accepts_the_environment(parameters: dict[str, Any]) -> None:
    environment = gym.make(INDUSTRIAL_BENCHMARK_ID, **parameters)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(environment.unwrapped)


def test_spaces_and_history_of_the_first_observation() -> None:
    environment = gym.make(INDUSTRIAL_BENCHMARK_ID, setpoint=40.0)
    observation, _ = environment.reset(seed=0)
    assert observation.shape == (180,)
    assert observation.dtype == np.float32
    frames = observation.reshape(30, 6)
    assert (frames == frames[0]).all()
    assert frames[0, :4].tolist() == [40.0, 50.0, 50.0, 50.0]
    following = environment.step(np.array([1.0, 0.0, 0.0], dtype=np.float32))[0].reshape(30, 6)
    assert following[0, 1] == 51.0
    np.testing.assert_array_equal(following[1:], frames[1:])
    assert environment.action_space == gym.spaces.Box(-1.0, 1.0, (3,), dtype=np.float32)


def test_single_environment_is_seeded_per_reset() -> None:
    environment = gym.make(INDUSTRIAL_BENCHMARK_ID)

    def run(seed: int | None) -> np.ndarray:
        observations = [environment.reset(seed=seed)[0]]
        observations += [environment.step(np.zeros(3, dtype=np.float32))[0] for _ in range(20)]
        return np.stack(observations)

    first = run(4)
    unseeded = run(None)
    assert not np.array_equal(first, unseeded)
    assert np.array_equal(first, run(4))
    assert np.array_equal(unseeded, run(None))  # the generator goes on the same way after seed 4


def test_time_is_the_only_end() -> None:
    environment = gym.make(INDUSTRIAL_BENCHMARK_ID, max_episode_steps=5)
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(3, dtype=np.float32))[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]


def test_start_state_option() -> None:
    start = {"velocity": 10.0, "gain": 20.0, "shift": 30.0}
    single = gym.make(INDUSTRIAL_BENCHMARK_ID)
    observation, _ = single.reset(seed=0, options={"start": start})
    assert observation[1:4].tolist() == [10.0, 20.0, 30.0]
    several = make_vec(2)
    observations, _ = several.reset(seed=0, options={"start": {**start, "gain": [20.0, 25.0]}})
    assert observations[:, 2].tolist() == [20.0, 25.0]
    for environment in (single, several):
        with pytest.raises(ValueError, match="unknown reset option 'begin'"):
            environment.reset(options={"begin": start})
        with pytest.raises(ValueError, match="unknown start value 'speed'"):
            environment.reset(options={"start": {"speed": 1.0}})


def test_vector_environment_behaves_as_single_ones() -> None:
    """One machine in a vector equals the single environment: same seed, same numbers."""
    single, several = gym.make(INDUSTRIAL_BENCHMARK_ID), make_vec(1)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (70, 1, 3)).astype(np.float32)
    np.testing.assert_array_equal(single.reset(seed=3)[0], several.reset(seed=3)[0][0])
    for action in actions:
        observation, reward, *_ = single.step(action[0])
        observations, rewards, *_ = several.step(action)
        np.testing.assert_array_equal(observation, observations[0])
        assert reward == rewards[0]


def test_vector_environment_meets_gymnasiums_conventions() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = RecordEpisodeStatistics(make_vec(3, max_episode_steps=4, setpoint=50.0))
        assert environment.num_envs == 3
        assert environment.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        observations, info = environment.reset(seed=0)
        assert info == {}
        assert observations in environment.observation_space
        assert environment.single_observation_space.contains(observations[0])
        for step in range(4):
            result = environment.step(environment.action_space.sample())
            observations, rewards, terminated, truncated, info = result
            assert observations in environment.observation_space
            assert rewards.shape == terminated.shape == truncated.shape == (3,)
            assert truncated.tolist() == [step == 3] * 3
            assert not terminated.any()
        assert info["episode"]["l"].tolist() == [4, 4, 4]
        environment.close()


def test_next_step_autoreset() -> None:
    environment = make_vec(2, max_episode_steps=2, history=1)
    environment.reset(seed=0)
    ones = np.ones((2, 3), dtype=np.float32)
    environment.step(ones)
    last, _, _, truncated, _ = environment.step(ones)
    assert truncated.all()
    assert last[:, 1].tolist() == [52.0, 52.0]
    first, rewards, _, truncated, _ = environment.step(ones)
    assert first[:, 1].tolist() == [50.0, 50.0]
    assert rewards.tolist() == [0.0, 0.0]
    assert not truncated.any()
    assert environment.step(ones)[0][:, 1].tolist() == [51.0, 51.0]


def test_same_step_autoreset_hands_out_the_final_observation() -> None:
    environment = make_vec(2, max_episode_steps=2, history=1, autoreset_mode="SameStep")
    environment.reset(seed=0)
    ones = np.ones((2, 3), dtype=np.float32)
    environment.step(ones)
    observations, rewards, _, truncated, info = environment.step(ones)
    assert truncated.all()
    assert observations[:, 1].tolist() == [50.0, 50.0]
    assert [final[1] for final in info["final_obs"]] == [52.0, 52.0]
    assert (rewards != 0.0).all()


def test_masked_reset_without_autoreset() -> None:
    environment = make_vec(3, max_episode_steps=2, history=2, autoreset_mode="Disabled")
    environment.reset(seed=0)
    ones = np.ones((3, 3), dtype=np.float32)
    environment.step(ones)
    assert environment.step(ones)[3].all()
    mask = np.array([True, False, True])
    observations, _ = environment.reset(options={"reset_mask": mask, "start": {"gain": 10.0}})
    assert observations[:, 1].tolist() == [50.0, 52.0, 50.0]
    assert observations[:, 2].tolist() == [10.0, 70.0, 10.0]
    assert observations[:, 7].tolist() == [50.0, 51.0, 50.0]
    assert environment.step(ones)[3].tolist() == [False, True, False]
    with pytest.raises(ValueError, match="3 booleans"):
        environment.reset(options={"reset_mask": [1, 0, 1]})


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"setpoint": -1.0}, "from 0 to 100"),
        ({"history": 0}, "at least 1"),
        ({"render_mode": "human"}, "does not exist"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_bad_parameters_are_refused(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(INDUSTRIAL_BENCHMARK_ID, **parameters)
    with pytest.raises(ValueError, match=message):
        make_vec(2, **parameters)


def test_step_before_reset_is_refused() -> None:
    single = gym.make(INDUSTRIAL_BENCHMARK_ID).unwrapped
    with pytest.raises(ValueError, match="before reset"):
        single.step(np.zeros(3))
    with pytest.raises(ValueError, match="reset all copies first"):
        make_vec(1).step(np.zeros((1, 3)))
