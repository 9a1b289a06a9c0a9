"""Model-based policy optimisation without any constraint: the control that is meant to fail.

Thesis 2.2.2 and figure 2.4: a policy is trained purely on virtual trajectories of the transition
ensemble, here LION's at lambda 1 (:mod:`components.algorithms.lion`) with neither its penalty nor
its cloning term, and with a policy that takes no lambda:

    loss = -mean over start states of sum_t gamma^t r_t / abs(mean return of the data)

Nothing keeps the policy where the ensemble knows the machine, so it learns to exploit the models'
errors wherever the log explored little. What LION takes over from its authors' code (start states,
scale of the return, member of lowest predicted reward) holds here too.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from components.algorithms.parts.learner import LearnerInputs, StackedLearner, descend, saturation
from components.algorithms.parts.virtual_returns import VirtualReturns
from components.core.random_streams import LaneStreams, spawn_generators
from components.networks import StackedMLP, lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam

__all__ = ["FRAME_EPSILON", "NEEDS", "TAKES_LAMBDA", "VERSION", "Config", "Learner"]

VERSION = 2
NEEDS = ("recurrent_ensemble",)
TAKES_LAMBDA = False
FRAME_EPSILON = 0.0


@dataclass(frozen=True, kw_only=True)
class Config:
    """LION's settings (thesis 6.6), as far as they apply."""

    updates: int = 1000
    hidden: tuple[int, ...] = (256, 256)  # policy layers
    learning_rate: float = 3e-4  # Adam
    trajectories: int = 200  # B, virtual trajectories per update
    horizon: int = 100  # steps of a virtual trajectory
    discount: float = 0.97  # gamma
    start_window: int = 30  # start states: the first so many steps of every trajectory
    start_after: int = 0  # but not the first so many of them, whose past is not all recorded

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        counts = (self.updates, self.trajectories, self.horizon, self.start_window, *self.hidden)
        if min(counts) < 1:
            raise ValueError(
                "updates, hidden, trajectories, horizon and start_window must be at least 1."
            )
        if not 0 <= self.start_after < self.start_window:
            raise ValueError("start_after must not be negative and lie below start_window.")
        if self.learning_rate <= 0:
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}.")
        if not 0 < self.discount <= 1:
            raise ValueError(f"discount must lie in (0, 1], got {self.discount}.")


class Learner(StackedLearner):
    """A stack of unconstrained policies, one lane per (dataset, seed)."""

    def __init__(self, config: Config, parts: LearnerInputs) -> None:
        self._data = parts.data
        data, device = parts.data, parts.data.device
        self.lanes = data.lanes
        self._returns = VirtualReturns(parts, config.horizon, config.discount)
        sizes = (data.observation_width, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(parts.keys, "policy"), sizes).to(device)
        self._optimizer = adam(list(self._actor.parameters()), config.learning_rate)
        self._networks = {"policy": self._actor}
        self._optimizers = {"policy": self._optimizer}
        start = self._returns.start_draw(
            config.trajectories, config.start_window, config.start_after
        )
        self._streams = LaneStreams(parts.keys, {"start": start}, device)

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One policy update on all lanes."""
        saturated: list[Tensor] = []

        def act(observations: Tensor) -> Tensor:
            actions = torch.tanh(self._actor(observations))
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
