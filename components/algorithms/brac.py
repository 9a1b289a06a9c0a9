"""BRAC-v: an actor-critic penalised for divergence from the behaviour, in policy and value.

Wu, Tucker, Nachum, "Behavior Regularized Offline Reinforcement Learning" (2019), with the KL
divergence in its primal form. In pretraining a squashed Gaussian ``b``, the behaviour, is fitted to
the log; then it is frozen:

    b:       mean [-log b(clip(a) | s) + alpha_e log b(a~ | s)],  a~ ~ b
    alpha_e: descends alpha_e (-log b(a~ | s) + A), not below 0   (target entropy -A)

Then, per update:

    critics' targets <- tau online + (1 - tau) target
    D(s)     = mean_i [log pi(a_i | s) - log b(clip(a_i) | s)],  four a_i ~ pi
    y        = r + gamma (1 - terminal) [min_j Q_target_j(s', a') - alpha D(s')],  a' ~ pi
    critics: sum_j mean (Q_j(s, a) - y)^2
    actor:   mean [alpha D(s) - min_j Q_j(s, a)],  without Q in the warm-up

There is no entropy bonus and no target actor; deployed is tanh of the mean. References disagree on
alpha and the actor's rate; taken are those of the authors' own primal example (0.1, 3e-4; the D4RL
evaluations used 1 and 3e-5). Its phases keep their share of the budget: 300,000 pretraining and
20,000 warm-up steps on a run of 500,000 become 0.6 (before the budget begins) and 0.04.

Deviations: the critics' targets start as copies (the authors' start as other random networks); the
first of the four actions is also the one that the critics evaluate; initial weights are PyTorch's.
Frames are standardised. The end of a logged trajectory is a time-out and is bootstrapped through.
gamma and the budget of 10,000 updates are the thesis's (5.1.2).
"""

import copy
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    Scalars,
    adam_each,
    bootstrapped,
    descend,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.networks import Critics, TanhGaussian, lanewise_mean, polyak_update
from components.networks.gaussian import Sample, log_density, raw_actions
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]

ACTION_MARGIN = 1e-3  # actions are kept this far from the bounds inside densities
LOG_STD_RANGE = (-5.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000  # after pretraining
    cloning: float = 0.6  # pretraining updates of the behaviour, as a share of ``updates``
    hidden: tuple[int, ...] = (200, 200)  # layers of actor and behaviour
    critic_hidden: tuple[int, ...] = (300, 300)
    actor_learning_rate: float = 3e-4  # Adam
    learning_rate: float = 1e-3  # Adam, critics
    cloning_learning_rate: float = 5e-4  # Adam, behaviour and its entropy weight
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    alpha: float = 0.1  # weight of the divergence penalty
    divergence_actions: int = 4  # samples behind D
    warm_up: float = 0.04  # first share of the updates, in which the actor does not see Q

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "divergence_actions")
        check_at_least_one(self, "hidden", "critic_hidden")
        check_bootstrapping(self.discount, self.target_rate)
        if min(self.actor_learning_rate, self.learning_rate, self.cloning_learning_rate) <= 0:
            raise ValueError("learning rates must be positive.")
        if self.alpha < 0 or self.cloning < 0 or not 0 <= self.warm_up <= 1:
            raise ValueError("alpha and cloning must not be negative; warm_up lies in [0, 1].")

    @property
    def pretraining(self) -> int:
        """Updates of the behaviour before the budget begins."""
        return round(self.cloning * self.updates)


class Learner(StackedLearner):
    """A stack of BRAC-v learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        self.lanes, self.pretraining = data.lanes, config.pretraining
        seen, acted = data.observation_width, data.action_width
        sizes = (seen, *config.hidden, acted)
        self._behaviour = TanhGaussian(keys, "behaviour", sizes, LOG_STD_RANGE, squash=True)
        self._actor = TanhGaussian(keys, "actor", sizes, LOG_STD_RANGE, squash=True).to(device)
        self._behaviour.to(device)
        self._critics = Critics(keys, seen, acted, config.critic_hidden).to(device)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._entropy_weight = Scalars(self.lanes, 1.0).to(device)
        self._networks = {
            "behaviour": self._behaviour,
            "entropy_weight": self._entropy_weight,
            "actor": self._actor,
            "critics": self._critics,
            "critics_target": self._critics_target,
        }
        rates = {
            "behaviour": config.cloning_learning_rate,
            "entropy_weight": config.cloning_learning_rate,
            "actor": config.actor_learning_rate,
            "critics": config.learning_rate,
        }
        self._optimizers = adam_each(self._networks, rates)
        several = Normal(config.batch, config.divergence_actions, acted)
        self._streams = LaneStreams(
            keys,
            {"row": data.row_draw(config.batch), "next": several, "actor": several},
            device,
        )

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations)[0])

    # -- losses -----------------------------------------------------------------------------

    def _behaviour_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Behaviour's loss and log density of its own actions, ``[L]`` each."""
        mean, log_std = self._behaviour(batch.observations)
        logged = log_density(mean, log_std, raw_actions(batch.actions, ACTION_MARGIN))
        own = lanewise_mean(self._behaviour.draw((mean, log_std), noise)[2])
        return self._entropy_weight.value.detach() * own - lanewise_mean(logged), own

    def _divergence(self, observations: Tensor, drawn: Sample) -> Tensor:
        """Sampled KL divergence ``[L, B]`` of the actor from the behaviour."""
        actions, _, density = drawn
        mean, log_std = (p[:, :, None] for p in self._behaviour(observations))
        logged = log_density(mean, log_std, raw_actions(actions, ACTION_MARGIN))
        return (density - logged).mean(dim=-1)

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]``, less the divergence penalty at the next state."""
        config, following = self._config, batch.next_observations
        drawn = self._actor.draw(self._actor(following), noise)
        values: Tensor = self._critics_target(following, drawn[0][:, :, 0]).amin(dim=1)
        ahead = values - config.alpha * self._divergence(following, drawn)
        return bootstrapped(batch, config.discount, ahead)

    def _actor_loss(
        self, batch: Batch, noise: Tensor, with_values: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        config = self._config
        drawn = self._actor.draw(self._actor(batch.observations), noise)
        divergence = lanewise_mean(self._divergence(batch.observations, drawn))
        loss = config.alpha * divergence
        metrics = {
            "actor/divergence": divergence.detach(),
            "actor/saturated_share": saturation(drawn[0]),
        }
        if with_values:
            values = self._critics.least(batch.observations, drawn[0][:, :, 0])
            loss = loss - lanewise_mean(values)
            metrics["critic/value_magnitude"] = lanewise_mean(values.detach().abs())
        return loss, metrics | {"actor/loss": loss.detach()}

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> str:
        """Phase: the behaviour's pretraining, the warm-up (values), the actor with values."""
        config, since = self._config, step - self.pretraining
        if since < 0:
            return "behaviour"
        return "values" if since < round(config.warm_up * config.updates) else "actor"

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on all lanes: of the behaviour at first, then of critics and actor."""
        drawn = self._streams.at(step)
        batch = self._data.batch(drawn["row"])
        if self.branch(step) == "behaviour":
            return self._pretrain(batch, drawn["actor"])
        return self._improve(batch, drawn, with_values=self.branch(step) == "actor")

    def _pretrain(self, batch: Batch, noise: Tensor) -> dict[str, Tensor]:
        loss, own = self._behaviour_loss(batch, noise[:, :, :1])
        descend(self._optimizers["behaviour"], loss)
        weight = self._entropy_weight.value
        descend(
            self._optimizers["entropy_weight"], weight * (self._data.action_width - own.detach())
        )
        with torch.no_grad():
            weight.clamp_(min=0.0)
        return {
            "behaviour/loss": loss.detach(),
            "behaviour/entropy": -own.detach(),
            "behaviour/entropy_weight": weight.detach().clone(),
        }

    def _improve(
        self, batch: Batch, drawn: dict[str, Tensor], *, with_values: bool
    ) -> dict[str, Tensor]:
        polyak_update([(self._critics_target, self._critics)], self._config.target_rate)
        targets = self._targets(batch, drawn["next"])
        critic_loss = self._critics.errors(batch.observations, batch.actions, targets).sum(dim=1)
        descend(self._optimizers["critics"], critic_loss)
        actor_loss, metrics = self._actor_loss(batch, drawn["actor"], with_values)
        descend(self._optimizers["actor"], actor_loss)
        return metrics | {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(
            card, {"actor": self._actor.mean_network()}, self._data.frame_scaling
        )


ALGORITHM: Final = Algorithm(
    name="brac",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(6.5e-5),
    frame_epsilon=1e-3,
)
