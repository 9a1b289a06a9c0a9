"""Model-based policy optimisation without any constraint: the control that is meant to fail.

Thesis 2.2.2 and figure 2.4: a policy is trained purely on virtual trajectories of the transition
ensemble, here by LION's objective at proximity 1 (:mod:`components.algorithms.lion`) with neither
its penalty nor its distance to logged actions, and with a policy that takes no proximity:

    loss = -mean over start states of sum_t gamma^t r_t / abs(mean return of the data)

Nothing keeps the policy where the ensemble predicts well, so it learns to exploit the models'
errors wherever the log explored little. What LION takes over from its authors' code (start states,
scale of the return, member of lowest predicted reward) holds here too.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_virtual_step
from components.algorithms.parts.learner import LearnerInputs, descend, saturation
from components.algorithms.parts.ranges import check_at_least_one, check_virtual_starts
from components.algorithms.parts.virtual_returns import VirtualReturns
from components.core.random_streams import LaneStreams, spawn_generators
from components.networks import StackedMLP, lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """LION's settings (thesis 6.6), as far as they apply."""

    updates: int = 1000
    hidden: tuple[int, ...] = (256, 256)  # policy layers
    learning_rate: float = 3e-4  # Adam
    trajectories: int = 200  # B, virtual trajectories per update
    horizon: int = 100  # steps of a virtual trajectory
    discount: float = 0.97  # gamma
    start_window: int = 30  # start states are steps start_after ... start_window - 1 of each
    start_after: int = 0  # logged trajectory; more than 0 where their past must all be recorded

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "hidden", "trajectories", "horizon", "start_window")
        check_virtual_starts(self.discount, self.start_window, self.start_after)
        if self.learning_rate <= 0:
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}.")


class Learner(StackedLearner):
    """A stack of unconstrained policies, one lane per (dataset, seed)."""

    updates_per_graph = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._data = inputs.data
        data, device = inputs.data, inputs.data.device
        self.lanes = data.lanes
        self._returns = VirtualReturns(inputs, config.horizon, config.discount)
        sizes = (data.observation_width, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(inputs.keys, "policy"), sizes).to(device)
        self._optimizer = adam(list(self._actor.parameters()), config.learning_rate)
        self._networks = {"policy": self._actor}
        self._optimizers = {"policy": self._optimizer}
        start = self._returns.start_draw(
            config.trajectories, config.start_window, config.start_after
        )
        self._streams = LaneStreams(inputs.keys, {"start": start}, device)

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations))

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One policy update on all lanes."""
        saturated: list[Tensor] = []

        def act(observations: Tensor) -> Tensor:
            actions = self.act(observations)
            saturated.append(saturation(actions))
            return actions

        returns = self._returns.of(self._streams.at(step)["start"], act)
        loss = -lanewise_mean(returns)
        descend(self._optimizer, loss)
        return {
            "policy/loss": loss.detach(),
            "policy/virtual_return": lanewise_mean((returns * self._returns.scale).detach()),
            "policy/saturated_share": torch.stack(saturated).mean(dim=0),
        }

    # -- what is deployed ------------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._actor.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="model_based",
    config=Config,
    learner=Learner,
    version=3,
    cost=per_virtual_step(9e-6),
    needs=("recurrent_ensemble",),
)
