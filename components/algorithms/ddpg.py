"""DDPG: deep deterministic policy gradient on logged data, the control without any regularisation.

Lillicrap et al., "Continuous Control with Deep Reinforcement Learning" (2016), in the form of
"OurDDPG" of Fujimoto et al., "Addressing Function Approximation Error in Actor-Critic Methods"
(2018). Per update:

    y  = r + gamma (1 - terminal) Q_target(s', pi_target(s'))
    critic: mean (Q(s, a) - y)^2
    actor:  -mean Q(s, pi(s)), with the critic just updated
    targets <- tau online + (1 - tau) target

References disagree on sizes; taken are OurDDPG's since 2021 (two layers of 256, Adam 3e-4, batch
256), which are those of TD3+BC without its tricks. Offline nothing corrects the values of actions
that were never logged, so they grow without bound and the actor leaves the data for the bounds of
the action box. That is the method's result here: neither values nor gradients are clipped. The same
update, :class:`ActorCritic`, trains online the experts that log the robot datasets
(:mod:`components.experts`); no offline learner uses those transitions.

Deviations: frames are standardised (the raw frames of the Industrial Benchmark are far from unit
scale). The end of a logged trajectory is a time-out and is bootstrapped through. gamma and the
budget of 10,000 updates are the thesis's (5.1.2).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    adam_each,
    bootstrapped,
    descend,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.random_streams import LaneStreams, spawn_generators
from components.data.batches import Batch
from components.networks import Critics, StackedMLP, lanewise_mean, polyak_update
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = [
    "ALGORITHM",
    "ActorCritic",
    "Config",
    "Learner",
]


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critic
    learning_rate: float = 3e-4  # Adam, actor and critic
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "hidden")
        check_bootstrapping(self.discount, self.target_rate)
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive.")


class ActorCritic(StackedLearner):
    """Networks, optimisers and the update of L learners, wherever the transitions come from.

    Args:
        config: Settings.
        keys: One random stream per lane.
        observations: Width O.
        actions: Width A.
        device: Where to learn.
    """

    updates_per_graph = 50

    def __init__(
        self,
        config: Config,
        keys: Sequence[int],
        observations: int,
        actions: int,
        device: torch.device,
    ) -> None:
        self._config = config
        self.lanes = len(keys)
        sizes = (observations, *config.hidden, actions)
        self._actor = StackedMLP(spawn_generators(keys, "actor"), sizes).to(device)
        self._critic = Critics(keys, observations, actions, config.hidden, count=1).to(device)
        self._actor_target = copy.deepcopy(self._actor).requires_grad_(False)
        self._critic_target = copy.deepcopy(self._critic).requires_grad_(False)
        self._networks = {
            "actor": self._actor,
            "critic": self._critic,
            "actor_target": self._actor_target,
            "critic_target": self._critic_target,
        }
        learned = ("actor", "critic")
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
    def _targets(self, batch: Batch) -> Tensor:
        """Bootstrapped values ``[L, B]`` of transitions."""
        actions = torch.tanh(self._actor_target(batch.next_observations))
        values = self._critic_target.first(batch.next_observations, actions)
        return bootstrapped(batch, self._config.discount, values)

    # -- update -----------------------------------------------------------------------------

    def learn(self, batch: Batch) -> dict[str, Tensor]:
        """One update of critic, actor and targets on all lanes."""
        targets = self._targets(batch)
        critic_loss = self._critic.errors(batch.observations, batch.actions, targets).sum(dim=1)
        descend(self._optimizers["critic"], critic_loss)
        actions = self.act(batch.observations)
        values = self._critic.first(batch.observations, actions)
        actor_loss = -lanewise_mean(values)
        descend(self._optimizers["actor"], actor_loss)
        moving = [(self._actor_target, self._actor), (self._critic_target, self._critic)]
        polyak_update(moving, self._config.target_rate)
        return {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
            "critic/value_magnitude": lanewise_mean(values.detach().abs()),
            "actor/loss": actor_loss.detach(),
            "actor/saturated_share": saturation(actions),
        }


class Learner(ActorCritic):
    """A stack of DDPG learners on logged data, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._data = data = inputs.data
        super().__init__(
            config, inputs.keys, data.observation_width, data.action_width, data.device
        )
        draws = {"row": data.row_draw(config.batch)}
        self._streams = LaneStreams(inputs.keys, draws, data.device)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on a batch of logged transitions."""
        return self.learn(self._data.batch(self._streams.at(step)["row"]))

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._actor.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="ddpg",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(2.2e-5),
    frame_epsilon=1e-3,
)
