"""Terminations are absorbed: by hand on a toy system, and on Hopper against Gymnasium."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator
from components.environments.mujoco.specifications import HOPPER
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import evaluate_policies
from components.policies.policy import Policy
from tests.components.synthetic import CPU, FEATURES, constant_policy, policy_card

NEVER = 99
STILL = constant_policy([0.0], history=1)


def make_toy(*lives: int) -> Callable[..., "Faller"]:
    return lambda name, copies, threads: Faller(lives)


class Faller:
    """Three copies that end after so many steps.

    The first feature counts the steps and the reward of step t is t + 1, but a copy that is stepped
    after its end shows and earns NaN.
    """

    frame_features, action_features = FEATURES, ("counter",)

    def __init__(self, lives: Sequence[int]) -> None:
        self._lives = np.array(lives)

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        self._steps = 0
        return self._frames()

    def reset_copies(self, copies: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        raise AssertionError("evaluation starts no copy again")

    @property
    def terminated(self) -> np.ndarray:
        # only the very step of the end is told: evaluation has to remember it
        return self._steps == self._lives

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._steps += 1
        rewards = np.where(self._steps <= self._lives, self._steps, np.nan)
        return self._frames(), rewards

    def _frames(self) -> np.ndarray:
        frames = np.zeros((3, 6))
        frames[:, 0] = np.where(self._steps <= self._lives, self._steps, np.nan)
        return frames


def test_rewards_and_states_after_the_end_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("components.evaluation.real.make_batch", make_toy(1, 3, NEVER))
    weight = torch.zeros(1, 6, 1)
    weight[0, 0, 0] = 0.1  # acts with tanh of a tenth of the counter
    scaling = Normaliser(torch.zeros(1, 6), torch.ones(1, 6))
    card = policy_card(history=1, actions=1)
    policy = Policy.of_networks(card, {"actor": [(weight, torch.zeros(1, 1, 1))]}, scaling)
    protocol = EvaluationProtocol(trajectories=3, horizon=5)
    [result] = evaluate_policies([policy], [STILL], "toy", {}, protocol, 0.5, [0], CPU)
    assert result.returns[0, 0].tolist() == [1.0, 1 + 1 + 0.75, 1 + 1 + 0.75 + 0.5 + 0.3125]
    away = np.tanh(0.1 * np.arange(5))
    # states 0; 0, 1, 2; 0, 1, 2, 3, 4
    expected = (away[:1].sum() + away[:3].sum() + away.sum()) / 9
    assert result.distances[0, 0] == pytest.approx(expected, rel=1e-6)  # actions in float32


def test_evaluation_is_over_when_all_copies_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("components.evaluation.real.make_batch", make_toy(1, 3, 2))
    protocol, told = EvaluationProtocol(trajectories=3, horizon=50), list[float]()
    [result] = evaluate_policies([STILL], [STILL], "toy", {}, protocol, 1.0, [0], CPU, told.append)
    assert result.returns[0, 0].tolist() == [1.0, 6.0, 3.0]
    assert told == [1 / 50, 2 / 50, 1.0]


def test_a_falling_hopper_earns_what_gymnasium_pays_until_then() -> None:
    policy = constant_policy([0.6, -0.3, 0.2], features=HOPPER.frame_features, history=1)
    action = policy.act(torch.zeros(1, 1, 1, 11))[0, 0].numpy()
    protocol = EvaluationProtocol(trajectories=3, horizon=60)
    parameters: dict[str, Any] = {"physics": "v3"}
    [result] = evaluate_policies(
        [policy], [policy], HOPPER.id, parameters, protocol, 0.99, [8], CPU
    )
    generator, lengths = lane_generator(8), []
    for trajectory in range(3):
        single = gym.make(HOPPER.id, **parameters).unwrapped
        single.np_random = generator
        single.reset()
        earned = 0.0
        for t in range(60):
            _, reward, terminated, *_ = single.step(action.astype(np.float64))
            earned += 0.99**t * float(reward)
            if terminated:
                lengths.append(t + 1)
                break
        # sixty terms are added in the same order
        assert result.returns[0, 0, trajectory] == pytest.approx(earned, rel=1e-14)
    assert len(lengths) == 3, "every trajectory ends in a fall"
    assert result.distances[0, 0] == 0.0
