"""BC: plain behaviour cloning, the reference row that shows what copying the log achieves.

``pi(s)`` minimises the mean squared distance to the logged action, averaged over action entries
(Pomerleau, "ALVINN", 1989). Rewards are not used. The sizes are those of the actor of TD3+BC, of
which this is the limit ``alpha = 0``. From data with random actions mixed in it learns the mean
action, and so is often better than the controller that it copies.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import LearnerInputs, descend, saturation
from components.algorithms.parts.ranges import check_at_least_one
from components.core.random_streams import LaneStreams, spawn_generators
from components.networks import StackedMLP, lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes and budget of the other model-free learners."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # policy layers
    learning_rate: float = 3e-4  # Adam
    batch: int = 256  # transitions per update

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "hidden")
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive.")


class Learner(StackedLearner):
    """A stack of BC policies, one lane per (dataset, seed)."""

    updates_per_graph = 50

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._data = data = inputs.data
        self.lanes = data.lanes
        sizes = (data.observation_width, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(inputs.keys, "actor"), sizes).to(data.device)
        self._networks = {"actor": self._actor}
        self._optimizers = {"actor": adam(list(self._actor.parameters()), config.learning_rate)}
        self._streams = LaneStreams(inputs.keys, {"row": data.row_draw(config.batch)}, data.device)

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations))

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One step towards the logged actions on all lanes."""
        index = self._streams.at(step)["row"]
        actions = self.act(self._data.observations(index))
        logged = self._data.actions(index)
        error = lanewise_mean(mse_loss(actions, logged, reduction="none"))
        descend(self._optimizers["actor"], error)
        return {
            "actor/imitation_error": error.detach(),
            "actor/saturated_share": saturation(actions),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._actor.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="bc",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(6e-6),
    frame_epsilon=1e-3,
)
