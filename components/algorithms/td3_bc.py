"""TD3+BC: an actor-critic pulled towards the logged actions.

Fujimoto and Gu, "A Minimalist Approach to Offline Reinforcement Learning" (2021). Per update:

    a' = clip(pi_target(s') + clip(N(0, 0.2), -0.5, 0.5), -1, 1)
    y  = r + gamma (1 - terminal) min_j Q_target_j(s', a')
    critics: sum_j mean (Q_j(s, a) - y)^2
    every second update:
    actor:   -mean Q_1(s, pi(s)) * alpha / mean|Q_1(s, pi(s))| + mean (pi(s) - a)^2
    targets <- tau online + (1 - tau) target

As in the authors' code, not the paper's text, the Q scale is taken at the policy's actions and the
targets move with the actor, every second update. States are normalised with deviation + 1e-3. The
end of a logged trajectory is a time-out and is bootstrapped through. gamma and the budget of 10,000
updates are the thesis's for the Industrial Benchmark (5.1.2).
"""

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from components.algorithms.base import Ingredients
from components.data.lanes import Batch
from components.networks import (
    LaneStreams,
    StackedMLP,
    lanewise_mean,
    polyak_update,
    spawn_generators,
)
from components.networks.checkpoint import (
    load_optimizer_state,
    module_state,
    optimizer_state,
    prefixed,
    with_prefix,
)
from components.networks.policy import Policy, PolicyCard
from components.networks.training import adam

__all__ = ["FRAME_EPSILON", "NEEDS", "TAKES_LAMBDA", "VERSION", "Config", "Learner"]

VERSION = 1
NEEDS: tuple[str, ...] = ()
TAKES_LAMBDA = False
FRAME_EPSILON = 1e-3  # added to every feature's deviation
CRITICS = 2


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critics
    learning_rate: float = 3e-4  # Adam, actor and critics
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    alpha: float = 2.5  # weight of Q against cloning
    smoothing: float = 0.2  # standard deviation of the target action's noise
    smoothing_clip: float = 0.5
    actor_every: int = 2  # critic updates per actor and target update

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        if min(self.updates, self.batch, self.actor_every, *self.hidden) < 1:
            raise ValueError("updates, batch, actor_every and hidden must be at least 1.")
        if not 0 < self.discount < 1 or not 0 < self.target_rate <= 1:
            raise ValueError("discount must lie in (0, 1) and target_rate in (0, 1].")
        if self.learning_rate <= 0 or min(self.alpha, self.smoothing, self.smoothing_clip) < 0:
            raise ValueError(
                "learning_rate must be positive; alpha, smoothing, smoothing_clip not negative."
            )


class Learner:
    """A stack of TD3+BC learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, parts: Ingredients) -> None:
        self._config, self._data = config, parts.data
        data, device = parts.data, parts.data.device
        self.lanes = data.lanes
        actor_sizes = (data.observation_width, *config.hidden, data.action_width)
        critic_sizes = (data.observation_width + data.action_width, *config.hidden, 1)
        critic_generators = [
            generators[lane]
            for lane in range(self.lanes)
            for generators in [
                spawn_generators(parts.keys, f"critic{number}") for number in range(CRITICS)
            ]
        ]
        self._actor = StackedMLP(spawn_generators(parts.keys, "actor"), actor_sizes).to(device)
        self._critics = StackedMLP(critic_generators, critic_sizes).to(device)  # lanes L * 2
        self._actor_target = copy.deepcopy(self._actor).requires_grad_(False)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._actor_optimizer = adam(list(self._actor.parameters()), config.learning_rate)
        self._critic_optimizer = adam(list(self._critics.parameters()), config.learning_rate)
        shape = (config.batch, data.action_width)
        self._streams = LaneStreams(
            parts.keys,
            {
                "row": lambda g, lane, steps: g.integers(
                    data.counts[lane], size=(steps, config.batch)
                ),
                "noise": lambda g, lane, steps: g.standard_normal((steps, *shape), np.float32),
            },
            device,
        )

    # -- networks ---------------------------------------------------------------------------

    def _values(self, critics: StackedMLP, observations: Tensor, actions: Tensor) -> Tensor:
        """Both critics' values: ``[L, B, O]`` and ``[L, B, A]`` to ``[L, 2, B]``."""
        inputs = torch.cat([observations, actions], dim=-1)
        twins = inputs[:, None].expand(-1, CRITICS, -1, -1).flatten(0, 1)
        return critics(twins).view(self.lanes, CRITICS, -1)  # type: ignore[no-any-return]

    def _first_value(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The first critic's values ``[L, B]``, without computing the second."""
        x = torch.cat([observations, actions], dim=-1)
        *hidden, (weight, bias) = self._critics.affine()
        for inner_weight, inner_bias in hidden:
            x = torch.relu(torch.baddbmm(inner_bias[::CRITICS], x, inner_weight[::CRITICS]))
        return torch.baddbmm(bias[::CRITICS], x, weight[::CRITICS]).squeeze(-1)

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]`` of the logged transitions."""
        config = self._config
        clip = config.smoothing_clip
        smoothing = (noise * config.smoothing).clamp(-clip, clip)
        actions = torch.tanh(self._actor_target(batch.next_observations))
        actions = (actions + smoothing).clamp(-1.0, 1.0)
        values = self._values(self._critics_target, batch.next_observations, actions)
        return batch.rewards + config.discount * batch.continues * values.amin(dim=1)

    def _critic_loss(self, batch: Batch, targets: Tensor) -> Tensor:
        """Squared errors of both critics, summed over them, ``[L]``."""
        values = self._values(self._critics, batch.observations, batch.actions)
        return (values - targets[:, None]).square().mean(dim=2).sum(dim=1)

    def _actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        actions = torch.tanh(self._actor(batch.observations))
        values = self._first_value(batch.observations, actions)
        magnitude = lanewise_mean(values.detach().abs())
        cloning = lanewise_mean((actions - batch.actions).square())
        loss = -self._config.alpha * lanewise_mean(values) / magnitude + cloning
        return loss, {"actor/loss": loss.detach(), "actor/cloning_error": cloning.detach()}

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One critic update on all lanes; every second time also actor and targets."""
        drawn = self._streams.at(step)
        batch = self._data.batch(drawn["row"])
        targets = self._targets(batch, drawn["noise"])
        critic_loss = self._critic_loss(batch, targets)
        self._critic_optimizer.zero_grad(set_to_none=True)
        critic_loss.sum().backward()
        self._critic_optimizer.step()
        metrics = {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
        }
        if (step + 1) % self._config.actor_every == 0:
            actor_loss, actor_metrics = self._actor_loss(batch)
            # Only the actor is stepped; the critics' parameters need no gradient here.
            gradients = torch.autograd.grad(actor_loss.sum(), list(self._actor.parameters()))
            for parameter, gradient in zip(self._actor.parameters(), gradients, strict=True):
                parameter.grad = gradient
            self._actor_optimizer.step()
            polyak_update(self._actor_target, self._actor, self._config.target_rate)
            polyak_update(self._critics_target, self._critics, self._config.target_rate)
            metrics |= actor_metrics
        return metrics

    # -- what is deployed and what is kept ----------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_network(card, self._actor, self._data.frame_scaling)

    def state_dict(self) -> dict[str, Tensor]:
        """Networks, targets and optimisers, lane axis first."""
        networks = {
            "actor": self._actor,
            "critics": self._critics,
            "actor_target": self._actor_target,
            "critics_target": self._critics_target,
        }
        return (
            module_state(networks)
            | prefixed("actor_optimizer", optimizer_state(self._actor_optimizer))
            | prefixed("critic_optimizer", optimizer_state(self._critic_optimizer))
        )

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned."""
        self._actor.load_state_dict(with_prefix("actor", state))
        self._critics.load_state_dict(with_prefix("critics", state))
        self._actor_target.load_state_dict(with_prefix("actor_target", state))
        self._critics_target.load_state_dict(with_prefix("critics_target", state))
        load_optimizer_state(self._actor_optimizer, with_prefix("actor_optimizer", state))
        load_optimizer_state(self._critic_optimizer, with_prefix("critic_optimizer", state))
