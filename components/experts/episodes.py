"""Returns of whole episodes of a policy on the real system, one per copy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from components.data.returns import window_returns
from components.environments.mujoco.robots import Robots

__all__ = ["EpisodeReturns", "episode_rewards", "evaluate_episodes"]

Array = npt.NDArray[np.float64]


def episode_rewards(
    act: Callable[[Array], Array],
    robots: Robots,
    generators: Sequence[np.random.Generator],
    horizon: int,
) -> Array:
    """Run one episode of every copy.

    Args:
        act: Maps frames ``[N, F]`` to actions ``[N, A]``.
        robots: N copies.
        generators: One per copy, for its start.
        horizon: Time limit of an episode, in steps.

    Returns:
        ``[N, horizon]`` rewards in time order, up to that of the step that ends in a fall; 0 after
        it.
    """
    rewards = np.zeros((len(generators), horizon))
    frames = robots.reset(generators)
    alive = np.ones(len(generators), dtype=np.bool_)
    for step in range(horizon):
        frames, reward = robots.step(act(frames))
        rewards[alive, step] = reward[alive]
        alive &= ~robots.terminated
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


def evaluate_episodes(
    act: Callable[[Array], Array],
    robots: Robots,
    generators: Sequence[np.random.Generator],
    *,
    horizon: int,
    discount: float,
    return_steps: int,
) -> EpisodeReturns:
    """Evaluate a policy by one episode per copy.

    Args:
        act: Maps frames ``[N, F]`` to actions ``[N, A]``.
        robots: N copies.
        generators: One per copy, for its start.
        horizon: Time limit of an episode, in steps.
        discount: Per step, of the discounted returns.
        return_steps: Steps that these sum over.
    """
    rewards = episode_rewards(act, robots, generators, horizon)
    returns = rewards.sum(axis=1)
    first = window_returns(rewards[:, :return_steps], discount, return_steps)
    return EpisodeReturns(float(returns.mean()), float(returns.std()), float(first.mean()))
