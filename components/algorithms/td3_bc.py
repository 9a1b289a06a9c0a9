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
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    adam_each,
    bootstrapped,
    descend,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.draws import Draw, Normal
from components.core.random_streams import LaneStreams, spawn_generators
from components.data.batches import Batch
from components.networks import Critics, StackedMLP, lanewise_mean, polyak_update
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critics
    learning_rate: float = 3e-4  # Adam, actor and critics
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    alpha: float = 2.5  # weight of Q against the distance to logged actions
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
        if self.learning_rate <= 0 or min(self.alpha, self.smoothing, self.smoothing_clip) < 0:
            raise ValueError(
                "learning_rate must be positive; alpha, smoothing, smoothing_clip not negative."
            )


class Learner(StackedLearner):
    """A stack of TD3+BC learners, one lane per (dataset, seed)."""

    _further_inputs = 0  # of all networks, after the observation

    updates_per_graph = 50

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device = inputs.data, inputs.data.device
        self.lanes = data.lanes
        seen = data.observation_width + self._further_inputs
        sizes = (seen, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(inputs.keys, "actor"), sizes).to(device)
        self._critics = Critics(inputs.keys, seen, data.action_width, config.hidden).to(device)
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
        self._streams = LaneStreams(inputs.keys, self._draws(), device)

    def _draws(self) -> dict[str, Draw]:
        batch = self._config.batch
        return {
            "row": self._data.row_draw(batch),
            "noise": Normal(batch, self._data.action_width),
        }

    def _batch(self, drawn: dict[str, Tensor]) -> Batch:
        return self._data.batch(drawn["row"])

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations))

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]`` of the logged transitions."""
        config = self._config
        clip = config.smoothing_clip
        smoothing = (noise * config.smoothing).clamp(-clip, clip)
        actions = torch.tanh(self._actor_target(batch.next_observations))
        actions = (actions + smoothing).clamp(-1.0, 1.0)
        values: Tensor = self._critics_target(batch.next_observations, actions)
        return bootstrapped(batch, config.discount, values.amin(dim=1))

    def _weigh(self, batch: Batch, gain: Tensor, distance: Tensor) -> Tensor:
        """Loss ``[L]`` of scaled values and squared distances to the log, ``[L, B]`` each."""
        return lanewise_mean(distance - gain)

    def _actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        actions = torch.tanh(self._actor(batch.observations))
        values = self._critics.first(batch.observations, actions)
        magnitude = lanewise_mean(values.detach().abs())
        distance = mse_loss(actions, batch.actions, reduction="none").mean(dim=-1)
        gain = values * (self._config.alpha / magnitude)[:, None]
        loss = self._weigh(batch, gain, distance)
        return loss, {
            "actor/loss": loss.detach(),
            "actor/imitation_error": lanewise_mean(distance.detach()),
            "actor/saturated_share": saturation(actions),
            "critic/value_magnitude": magnitude,
        }

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> bool:
        """Whether the update includes the actor and the targets."""
        return (step + 1) % self._config.actor_every == 0

    def update(self, step: int) -> dict[str, Tensor]:
        """One critic update on all lanes; every second time also actor and targets."""
        drawn = self._streams.at(step)
        batch = self._batch(drawn)
        targets = self._targets(batch, drawn["noise"])
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

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._actor.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="td3_bc",
    config=Config,
    learner=Learner,
    version=3,
    cost=per_transition(2.5e-5),
    frame_epsilon=1e-3,
)
