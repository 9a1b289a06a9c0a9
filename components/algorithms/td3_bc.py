"""TD3+BC: an actor-critic pulled towards the logged actions.

Fujimoto and Gu, "A Minimalist Approach to Offline Reinforcement Learning" (2021): TD3, see
:mod:`components.algorithms.parts.twin_delayed`, with another loss of the actor:

    -mean Q_1(s, pi(s)) * alpha / mean|Q_1(s, pi(s))| + mean (pi(s) - a)^2

As in the authors' code, not the paper's text, the Q scale is taken at the policy's actions. States
are normalised with deviation + 1e-3. The end of a logged trajectory is a time-out and is
bootstrapped through. gamma and the budget of 10,000 updates are the thesis's for the Industrial
Benchmark (5.1.2).
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import LearnerInputs, saturation
from components.algorithms.parts.twin_delayed import TwinDelayed, TwinDelayedConfig
from components.core.draws import Draw, Normal
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.networks import lanewise_mean
from components.policies.policy import Policy, PolicyCard

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config(TwinDelayedConfig):
    """TD3's settings, and the weight of its values."""

    alpha: float = 2.5  # weight of Q against the distance to logged actions

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        super().__post_init__()
        if self.alpha < 0:
            raise ValueError("alpha must not be negative.")


class Learner(TwinDelayed):
    """A stack of TD3+BC learners, one lane per (dataset, seed)."""

    _config: Config

    _further_inputs = 0  # of all networks, after the observation

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._data = data = inputs.data
        device = data.device
        seen = data.observation_width + self._further_inputs
        super().__init__(config, inputs.keys, seen, data.action_width, device)
        self._streams = LaneStreams(inputs.keys, self._draws(), device)

    def _draws(self) -> dict[str, Draw]:
        batch = self._config.batch
        return {
            "row": self._data.row_draw(batch),
            "noise": Normal(batch, self._data.action_width),
        }

    def _batch(self, drawn: dict[str, Tensor]) -> Batch:
        return self._data.batch(drawn["row"])

    # -- losses -----------------------------------------------------------------------------

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

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on a batch of logged transitions."""
        drawn = self._streams.at(step)
        return self.learn(step, self._batch(drawn), drawn["noise"])

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
