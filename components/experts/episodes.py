"""Whole episodes of a policy on the real system, every copy from a start of its own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from components.data.returns import window_returns
from components.environments.mujoco.robots import Robots

__all__ = ["EpisodeReturns", "episode_rewards", "judge"]

Array = npt.NDArray[np.float64]


def episode_rewards(
    act: Callable[[Array], Array],
    machine: Robots,
    generators: Sequence[np.random.Generator],
    horizon: int,
) -> Array:
    """Let every copy live one episode.

    Args:
        act: Maps frames ``[N, F]`` to actions ``[N, A]``.
        machine: N copies.
        generators: One per copy, for its start.
        horizon: Steps after which time is up.

    Returns:
        ``[N, horizon]`` rewards in time order; 0 after a fall, whose own reward counts.
    """
    rewards = np.zeros((len(generators), horizon))
    frames = machine.reset(generators)
    alive = np.ones(len(generators), dtype=np.bool_)
    for step in range(horizon):
        frames, reward = machine.step(act(frames))
        rewards[alive, step] = reward[alive]
        alive &= ~machine.terminated
        if not alive.any():
            break
    return rewards


@dataclass(frozen=True)
class EpisodeReturns:
    """What a policy achieved in whole episodes.

    Attributes:
        return_mean: Mean of the undiscounted returns.
        return_std: Their standard deviation.
        discounted_return_mean: Mean of the discounted returns of the first steps.
    """

    return_mean: float
    return_std: float
    discounted_return_mean: float


def judge(
    act: Callable[[Array], Array],
    machine: Robots,
    generators: Sequence[np.random.Generator],
    *,
    horizon: int,
    discount: float,
    return_steps: int,
) -> EpisodeReturns:
    """Judge a policy by one episode per copy, see :func:`episode_rewards`."""
    rewards = episode_rewards(act, machine, generators, horizon)
    returns = rewards.sum(axis=1)
    first = window_returns(rewards[:, :return_steps], discount, return_steps)
    return EpisodeReturns(float(returns.mean()), float(returns.std()), float(first.mean()))
