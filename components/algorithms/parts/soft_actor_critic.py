"""Soft actor-critic, the learner inside MOPO, independent of where its transitions come from.

Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018), with a learned temperature.
Per update, on one batch, ``alpha = exp(log_alpha)``:

    y        = r + gamma (1 - terminal) [min_j Q_target_j(s', a') - alpha log pi(a' | s')],  a' ~ pi
    critics: sum_j 0.5 mean (Q_j(s, a) - y)^2
    actor:   mean [alpha log pi(a~ | s) - min_j Q_j(s, a~)],  a~ ~ pi
    temperature: log_alpha descends -log_alpha (log pi(a~ | s) - A)        (target entropy -A)
    targets <- tau online + (1 - tau) target

in this order; the temperature steps on the densities that the actor's loss has used. The authors
of MOPO take -3 as the target entropy of all tasks, which is -A where there are three actions.
Deployed is tanh of the mean.
"""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from components.algorithms.parts.learner import (
    Scalars,
    adam_each,
    bootstrapped,
    descend,
    saturation,
)
from components.data.batches import Batch, LaneData
from components.networks import Critics, TanhGaussian, lanewise_mean, polyak_update
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["LOG_STD_RANGE", "SoftActorCritic"]

LOG_STD_RANGE = (-20.0, 2.0)


class SoftActorCritic(StackedLearner):
    """A stack of actors, twin critics and temperatures.

    Args:
        data: The lanes' datasets, for widths and scaling.
        keys: One random stream per lane.
        hidden: Layers of actor and critics.
        learning_rate: Adam, of all three.
        discount: gamma.
        target_rate: tau.
    """

    def __init__(
        self,
        data: LaneData,
        keys: Sequence[int],
        *,
        hidden: Sequence[int],
        learning_rate: float,
        discount: float,
        target_rate: float,
    ) -> None:
        self.lanes, device = data.lanes, data.device
        self._data, self._discount, self._target_rate = data, discount, target_rate
        seen, acted = data.observation_width, data.action_width
        self._actor = TanhGaussian(keys, "actor", (seen, *hidden, acted), LOG_STD_RANGE).to(device)
        self._critics = Critics(keys, seen, acted, hidden).to(device)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._log_temperature = Scalars(self.lanes, 0.0).to(device)
        self._networks = {
            "actor": self._actor,
            "critics": self._critics,
            "critics_target": self._critics_target,
            "log_temperature": self._log_temperature,
        }
        learned = ("actor", "critics", "log_temperature")
        self._optimizers = adam_each(self._networks, dict.fromkeys(learned, learning_rate))

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations)[0])

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped soft values ``[L, B]``."""
        following = batch.next_observations
        actions, _, density = self._actor.draw(self._actor(following), noise)
        values: Tensor = self._critics_target(following, actions.squeeze(2)).amin(dim=1)
        temperature = self._log_temperature.value.exp()[:, None]
        ahead = values - temperature * density.squeeze(2)
        return bootstrapped(batch, self._discount, ahead)

    def _actor_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Loss and mean log density of the actions ``[L]``, and metrics."""
        actions, _, density = self._actor.draw(self._actor(batch.observations), noise)
        entropy_cost = lanewise_mean(density)
        values = self._critics.least(batch.observations, actions.squeeze(2))
        temperature = self._log_temperature.value.detach().exp()
        loss = temperature * entropy_cost - lanewise_mean(values)
        return (
            loss,
            entropy_cost.detach(),
            {
                "actor/loss": loss.detach(),
                "actor/entropy": -entropy_cost.detach(),
                "actor/saturated_share": saturation(actions),
                "critic/value_magnitude": lanewise_mean(values.detach().abs()),
            },
        )

    # -- update -----------------------------------------------------------------------------

    def improve(self, batch: Batch, following: Tensor, own: Tensor) -> dict[str, Tensor]:
        """One step of critics, actor, temperature and targets on all lanes.

        Args:
            batch: Transitions, logged or virtual.
            following: Standard normal ``[L, B, 1, A]``, for the actions at the next states.
            own: The same for the actions of the actor's loss.
        """
        targets = self._targets(batch, following)
        errors = self._critics.errors(batch.observations, batch.actions, targets)
        critic_loss = 0.5 * errors.sum(dim=1)
        descend(self._optimizers["critics"], critic_loss)
        actor_loss, entropy_cost, metrics = self._actor_loss(batch, own)
        descend(self._optimizers["actor"], actor_loss)
        surplus = entropy_cost - own.shape[-1]  # log density above that of the target entropy
        descend(self._optimizers["log_temperature"], -self._log_temperature.value * surplus)
        polyak_update([(self._critics_target, self._critics)], self._target_rate)
        return metrics | {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
            "actor/temperature": self._log_temperature.value.detach().exp(),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(
            card, {"actor": self._actor.mean_network()}, self._data.frame_scaling
        )
