"""Refinement of a trained expert: augmented random search on its output layer.

Mania, Guy, Recht, "Simple Random Search Provides a Competitive Approach to Reinforcement Learning"
(2018), version V1 with all directions. An actor that walks but falls early is near one that does
not, and a search needs no critic that has learned about falls. With z the leading principal
components of what the last hidden layer shows on the expert's own episodes, whitened, an iteration
is

    R+-_n = return of a whole episode of the policy tanh(output + (theta +- nu delta_n) [z, 1])
    theta <- theta + alpha / (N s) sum_n (R+_n - R-_n) delta_n      delta_n ~ N(0, 1) per entry

where both episodes of a pair begin alike and s is the deviation of all 2 N returns. The sum
``theta [z, 1]`` is linear in the hidden layer, so the result is a policy of the same shape.

This uses the real system, as the training before it does: an expert is part of data generation.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.core.random_streams import lane_generator, lane_key
from components.environments.mujoco.robots import Robots
from components.experts.episodes import episode_rewards
from components.policies.policy import Policy
from components.training.loop import Curves, TrainingLoop

__all__ = ["OutputSearch", "RefinementConfig", "refine"]

Array = npt.NDArray[np.float64]
MakeRobots = Callable[[int], Robots]


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """How an expert is refined."""

    iterations: int = 0  # of the search; 0: none
    directions: int = 16  # N, of an iteration; each is two episodes
    components: int = 32  # of the last hidden layer; all others stay as they are
    perturbation: float = 0.03  # nu, of the output before its tanh, per component
    step_size: float = 0.05  # alpha
    evaluate_every: int = 10  # iterations
    episodes: int = 20  # of an evaluation

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the field and its range.
        """
        counts = ("directions", "components", "evaluate_every", "episodes")
        if self.iterations < 0 or min(getattr(self, name) for name in counts) < 1:
            raise ValueError(f"iterations must not be negative, {', '.join(counts)} at least 1.")
        if self.iterations and self.evaluate_every > self.iterations:
            raise ValueError(
                f"evaluate_every={self.evaluate_every} is more than iterations={self.iterations}: "
                "no policy would be evaluated; lower it."
            )
        if min(self.perturbation, self.step_size) <= 0:
            raise ValueError("perturbation and step_size must be positive.")


class OutputSearch:
    """The search, one lane.

    Args:
        config: Settings.
        key: Of all random numbers.
        policy: The expert, one lane, of ReLU layers and a tanh.
        make_robots: Makes the given number of copies of the robot.
        horizon: Time limit of an episode, in steps.
    """

    lanes = 1

    def __init__(
        self,
        config: RefinementConfig,
        key: int,
        policy: Policy,
        make_robots: MakeRobots,
        horizon: int,
    ) -> None:
        self._config, self._key, self._policy, self._horizon = config, key, policy, horizon
        scaling = policy.frames
        self._mean, self._scale = scaling.mean.double().numpy(), scaling.scale.double().numpy()
        layers = [(w[0].double().numpy(), b[0].double().numpy()) for w, b in policy.layers]
        *self._hidden, self._output = layers
        self._robots = make_robots(2 * config.directions)
        self._evaluated = make_robots(config.episodes)
        self._centre, self._basis = self._principal_components()
        self._theta = np.zeros((self._basis.shape[1] + 1, len(self._output[1].T)))
        self._best, self._best_return, self._best_step = self._theta.copy(), -np.inf, 0

    # -- the policy -------------------------------------------------------------------------

    def _shown(self, frames: Array) -> Array:
        """What the last hidden layer shows, ``[N, H]``."""
        x: Array = (frames - self._mean) / self._scale
        for weight, bias in self._hidden:
            x = np.maximum(x @ weight + bias, 0.0)
        return x

    def _act(self, frames: Array, theta: Array) -> Array:
        """Actions ``[N, A]`` of one ``theta [K + 1, A]``, or of one for each copy."""
        shown = self._shown(frames)
        weight, bias = self._output
        z = np.concatenate([(shown - self._centre) @ self._basis, np.ones((len(shown), 1))], axis=1)
        more = z @ theta if theta.ndim == 2 else np.einsum("nk,nka->na", z, theta)
        actions: Array = np.tanh(shown @ weight + bias + more)
        return actions

    def _principal_components(self) -> tuple[Array, Array]:
        """Mean ``[H]`` and whitening basis ``[H, K]`` of the hidden layer in the own episodes."""
        seen: list[Array] = []

        def act(frames: Array) -> Array:
            shown = self._shown(frames)
            seen.append(shown[~self._evaluated.terminated])
            weight, bias = self._output
            actions: Array = np.tanh(shown @ weight + bias)
            return actions

        self._episodes(act, self._evaluated, "components", 0)
        shown = np.concatenate(seen)
        centre: Array = shown.mean(axis=0)
        variances, vectors = np.linalg.eigh(np.cov(shown.T))
        used = slice(-self._config.components, None)
        deviations = np.sqrt(np.maximum(variances[used], 1e-12 * variances[-1]))
        return centre, vectors[:, used] / deviations

    # -- episodes ---------------------------------------------------------------------------

    def _episodes(
        self, act: Callable[[Array], Array], robots: Robots, name: str, step: int, alike: int = 1
    ) -> Array:
        """Returns of an episode per copy; so many copies in a row begin alike."""
        key = lane_key(self._key, name, step)
        starts = [lane_generator(key, copy // alike) for copy in range(robots.copies)]
        returns: Array = episode_rewards(act, robots, starts, self._horizon).sum(axis=1)
        return returns

    def evaluate(self, done: int) -> float:
        """Mean return of the present policy in new episodes; the best one is kept."""
        returns = self._episodes(
            lambda frames: self._act(frames, self._theta), self._evaluated, "evaluation", done
        )
        reached = float(returns.mean())
        if reached > self._best_return:
            self._best, self._best_return, self._best_step = self._theta.copy(), reached, done
        return reached

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One iteration."""
        config = self._config
        rng = lane_generator(lane_key(self._key, "directions"), step)
        directions = rng.standard_normal((config.directions, *self._theta.shape))
        away = config.perturbation * np.stack([directions, -directions], axis=1)
        tried = self._theta + away.reshape(-1, *self._theta.shape)
        returns = self._episodes(
            lambda frames: self._act(frames, tried), self._robots, "search", step, alike=2
        )
        gains = returns.reshape(-1, 2) @ [1.0, -1.0]
        deviation = returns.std()
        if deviation > 0:
            rate = config.step_size / (config.directions * deviation)
            self._theta = self._theta + rate * np.tensordot(gains, directions, axes=1)
        return {"search/return": torch.from_numpy(returns[None]).mean(dim=1)}

    # -- what is kept -----------------------------------------------------------------------

    @property
    def best(self) -> tuple[Policy, float, int]:
        """The best policy, its mean return at that evaluation, and its iteration."""
        change = self._basis @ self._best[:-1]
        output = self._output[0] + change, self._output[1] + self._best[-1] - self._centre @ change
        *hidden, _ = self._policy.layers
        weight, bias = (torch.from_numpy(part)[None].float() for part in output)
        layers = [*hidden, (weight, bias)]
        card = replace(self._policy.card, steps=(self._policy.card.steps[0] + self._best_step,))
        policy = Policy.of_networks(card, {"actor": layers}, self._policy.frames)
        return policy, self._best_return, self._best_step

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next iteration depends on."""
        return {
            "theta": torch.from_numpy(self._theta)[None],
            "best": torch.from_numpy(self._best)[None],
            "best_return": torch.tensor([self._best_return], dtype=torch.float64),
            "best_step": torch.tensor([self._best_step]),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self._theta, self._best = (state[name][0].numpy().copy() for name in ("theta", "best"))
        self._best_return = float(state["best_return"][0])
        self._best_step = int(state["best_step"][0])


def refine(
    config: RefinementConfig,
    key: int,
    member: str,
    policy: Policy,
    make_robots: MakeRobots,
    *,
    horizon: int,
    work: Path,
    progress: Callable[[float], None] = lambda fraction: None,
    save_every: float = 60.0,
) -> tuple[Policy, float, int, Curves]:
    """Refine an expert.

    Args:
        config: Settings.
        key: Of all random numbers.
        member: Name of the search, stable across restarts.
        policy: The expert.
        make_robots: Makes copies of the robot.
        horizon: Time limit of an episode, in steps.
        work: Folder that survives a kill; holds the checkpoint.
        progress: Called with the finished fraction, 0 to 1.
        save_every: Seconds between checkpoints.

    Returns:
        The best policy, the mean return it had when it was evaluated, its iteration, the curves.
    """
    search = OutputSearch(config, key, policy, make_robots, horizon)

    def evaluate(done: int, curves: Curves) -> bool:
        reached = torch.tensor([search.evaluate(done)], dtype=torch.float64)
        curves.add(done, {"evaluation/return": reached})
        return False

    loop = TrainingLoop(
        config.iterations,
        [member],
        work / "checkpoint.safetensors",
        1,
        save_every,
        progress,
    )
    every = config.evaluate_every
    curves = loop.run(search, evaluate, range(every, config.iterations + 1, every))
    return *search.best, curves
