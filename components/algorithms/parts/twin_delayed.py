"""TD3: twin critics, smoothed target actions and a delayed actor, shared by those that build on it.

Fujimoto et al., "Addressing Function Approximation Error in Actor-Critic Methods" (2018). Per
update:

    a' = clip(pi_target(s') + clip(N(0, 0.2), -0.5, 0.5), -1, 1)
    y  = r + gamma (1 - terminal) min_j Q_target_j(s', a')
    critics: sum_j mean (Q_j(s, a) - y)^2
    every second update:
    actor:   -mean Q_1(s, pi(s))
    targets <- tau online + (1 - tau) target

As in the authors' code, the targets move with the actor, every second update. Where the transitions
come from is the caller's: TD3+BC learns from a log and changes the actor's loss, the experts of the
robots (:mod:`components.experts`) learn from what they just did.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from components.algorithms.parts.learner import adam_each, bootstrapped, descend, saturation
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.random_streams import spawn_generators
from components.data.batches import Batch
from components.networks import Critics, StackedMLP, lanewise_mean, polyak_update
from components.training.stacked_learner import StackedLearner

__all__ = ["TwinDelayed", "TwinDelayedConfig"]


@dataclass(frozen=True, kw_only=True)
class TwinDelayedConfig:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critics
    learning_rate: float = 3e-4  # Adam, actor and critics
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    smoothing: float = 0.2  # standard deviation of the target action's noise
    smoothing_clip: float = 0.5
    actor_every: int = 2  # critic updates per actor and target update

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "actor_every", "hidden")
        check_bootstrapping(self.discount, self.target_rate)
        if self.learning_rate <= 0 or min(self.smoothing, self.smoothing_clip) < 0:
            raise ValueError(
                "learning_rate must be positive; smoothing and smoothing_clip not negative."
            )


class TwinDelayed(StackedLearner):
    """Networks, optimisers and the update of L learners, wherever the transitions come from.

    Args:
        config: Settings.
        keys: One random stream per lane.
        observations: Width O of what the networks see.
        actions: Width A.
        device: Where to learn.
    """

    updates_per_graph = 50

    def __init__(
        self,
        config: TwinDelayedConfig,
        keys: Sequence[int],
        observations: int,
        actions: int,
        device: torch.device,
    ) -> None:
        self._config = config
        self.lanes = len(keys)
        sizes = (observations, *config.hidden, actions)
        self._actor = StackedMLP(spawn_generators(keys, "actor"), sizes).to(device)
        self._critics = Critics(keys, observations, actions, config.hidden).to(device)
        self._actor_target = copy.deepcopy(self._actor).requires_grad_(False)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._networks = {
            "actor": self._actor,
            "critics": self._critics,
            "actor_target": self._actor_target,
            "critics_target": self._critics_target,
        }
        learned = ("actor", "critics")
        self._optimizers = adam_each(self._networks, dict.fromkeys(learned, config.learning_rate))

    @property
    def actor(self) -> StackedMLP:
        """The networks whose tanh acts."""
        return self._actor

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations))

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]`` of transitions."""
        config = self._config
        clip = config.smoothing_clip
        smoothing = (noise * config.smoothing).clamp(-clip, clip)
        actions = torch.tanh(self._actor_target(batch.next_observations))
        actions = (actions + smoothing).clamp(-1.0, 1.0)
        values: Tensor = self._critics_target(batch.next_observations, actions)
        return bootstrapped(batch, config.discount, values.amin(dim=1))

    def _actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss ``[L]`` of the actor, and metrics."""
        actions = torch.tanh(self._actor(batch.observations))
        values = self._critics.first(batch.observations, actions)
        loss = -lanewise_mean(values)
        return loss, {
            "actor/loss": loss.detach(),
            "actor/saturated_share": saturation(actions),
            "critic/value_magnitude": lanewise_mean(values.detach().abs()),
        }

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> bool:
        """Whether the update includes the actor and the targets."""
        return (step + 1) % self._config.actor_every == 0

    def learn(self, step: int, batch: Batch, noise: Tensor) -> dict[str, Tensor]:
        """One critic update on all lanes; every second time also actor and targets.

        Args:
            step: Of the training.
            batch: ``[L, B]`` transitions.
            noise: ``[L, B, A]`` standard normal, of the target actions.
        """
        targets = self._targets(batch, noise)
        critic_loss = self._critics.errors(batch.observations, batch.actions, targets).sum(dim=1)
        descend(self._optimizers["critics"], critic_loss)
        metrics = {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
        }
        if self.branch(step):
            actor_loss, actor_metrics = self._actor_loss(batch)
            descend(self._optimizers["actor"], actor_loss)
            moving = [(self._actor_target, self._actor), (self._critics_target, self._critics)]
            polyak_update(moving, self._config.target_rate)
            metrics |= actor_metrics
        return metrics
