"""LION: a policy whose proximity to the logged behaviour is an input, set at run time.

Swazinna, Udluft, Runkler, "User-Interactive Offline Reinforcement Learning" (2022); thesis 6.4,
equations 6.3 to 6.8 and algorithm 3. The policy ``pi(s, lambda)`` is trained purely on virtual
trajectories of a learned transition ensemble. Per update and lane:

    draw B start states and a lambda ~ Beta(0.1, 0.1) for each trajectory
    roll pi(., lambda) out for H steps, every step taking the member of lowest predicted reward
    R = sum_t gamma^t r_t / abs(mean return of the data)          (return in the data's scale)
    P = sum_t gamma^t mean_d (pi - beta)_d^2 / H                  (distance to the behaviour, 6.3)
    loss = mean[-lambda R + (1 - lambda) P] + eta mean ||a - pi(s, 0)||^2 over logged (s, a)   (6.7)

Known deviations from the text, following the authors' code where it differs: start states come from
the first ``start_window`` steps of each trajectory; rewards are scaled by the mean discounted
window return of the dataset, or by ``return_scale``; the penalty is divided by the horizon; the
proximity enters the network standardised. The logged actions are drawn from the whole dataset (the
authors' code reaches only its first part).

``caution`` is no part of the thesis: a price on leaving the log's support, see
:mod:`~components.algorithms.parts.caution`.
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_virtual_step
from components.algorithms.parts.caution import MEASURES, check_caution
from components.algorithms.parts.learner import LearnerInputs, descend, needed
from components.algorithms.parts.ranges import check_at_least_one, check_virtual_starts
from components.algorithms.parts.virtual_returns import AGGREGATIONS, TRANSITIONS, VirtualReturns
from components.core.draws import Beta, Draw
from components.core.options import option
from components.core.random_streams import LaneStreams, spawn_generators
from components.models.transition.model_environment import discounted_sum
from components.networks import StackedMLP, lanewise_mean
from components.policies.deployment import KINDS
from components.policies.policy import PROXIMITY_SCALING, Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """LION's settings (thesis 6.6)."""

    updates: int = 1000
    hidden: tuple[int, ...] = (256, 256)  # policy layers
    learning_rate: float = 3e-4  # Adam
    trajectories: int = 200  # B, virtual trajectories per update; also logged actions
    horizon: int = 100  # H, steps of a virtual trajectory
    discount: float = 0.97  # gamma
    beta: float = 0.1  # both parameters of the proximity's Beta distribution
    eta: float = 0.1  # weight of the distance to logged actions at proximity 0
    start_window: int = 30  # start states are steps start_after ... start_window - 1 of each
    start_after: int = 0  # logged trajectory; more than 0 where their past must all be recorded
    return_scale: float | None = option(None)  # by which returns are divided; None: by the log's
    transition: str = option(TRANSITIONS[0])  # or deterministic_ensemble, which has no memory
    caution: float | None = option(None)  # price of leaving the log's support, in mean returns
    caution_by: str = option(MEASURES[0])  # or disagreement, of the members
    aggregation: str = option(AGGREGATIONS[0])  # of the members; or mean, single (figure 6.11)

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "hidden", "trajectories", "horizon", "start_window")
        check_virtual_starts(self.discount, self.start_window, self.start_after)
        if self.learning_rate <= 0 or self.beta <= 0 or self.eta < 0:
            raise ValueError("learning_rate and beta must be positive and eta not negative.")
        if self.transition not in TRANSITIONS:
            raise ValueError(f"transition must be one of {', '.join(TRANSITIONS)}.")
        if self.aggregation not in AGGREGATIONS:
            raise ValueError(f"aggregation must be one of {', '.join(AGGREGATIONS)}.")
        if self.return_scale is not None and self.return_scale <= 0:
            raise ValueError("return_scale must be positive, or null for the log's mean return.")
        check_caution(self.caution, self.caution_by)


class Learner(StackedLearner):
    """A stack of LION policies, one lane per (dataset, seed)."""

    updates_per_graph = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device = inputs.data, inputs.data.device
        self.lanes = data.lanes
        behaviours = inputs.fitted("behaviour_policy", Policy)
        self._behaviour = Policy.concatenate(behaviours[0].card, behaviours).to(device)
        self._returns = VirtualReturns(
            inputs,
            config.horizon,
            config.discount,
            config.transition,
            config.return_scale,
            config.aggregation,
        )
        self._returns.be_cautious(
            config.caution,
            self._behaviour_act,
            config.start_window,
            config.start_after,
            config.caution_by,
        )
        sizes = (data.observation_width + 1, *config.hidden, data.action_width)
        self._network = StackedMLP(spawn_generators(inputs.keys, "policy"), sizes).to(device)
        self._optimizer = adam(list(self._network.parameters()), config.learning_rate)
        self._networks = {"policy": self._network}
        self._optimizers = {"policy": self._optimizer}
        self._proximity_scaling = PROXIMITY_SCALING.to(device)
        self._streams = LaneStreams(inputs.keys, self._draws(), device)

    def _draws(self) -> dict[str, Draw]:
        batch, beta = self._config.trajectories, self._config.beta
        return {
            "start": self._returns.start_draw(
                batch, self._config.start_window, self._config.start_after
            ),
            "proximity": Beta(beta, batch),
            "clone": self._data.row_draw(batch),
        }

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        scaled = self._proximity_scaling.apply(needed(proximity, "proximity")[..., None])
        return torch.tanh(self._network(torch.cat([observations, scaled], dim=-1)))

    def _behaviour_act(self, observations: Tensor) -> Tensor:
        """Actions of the behaviour policies, differentiable in the observations."""
        return KINDS["tanh"](self._behaviour.networks, observations, None, 0.0)

    # -- losses -----------------------------------------------------------------------------

    def _virtual_losses(self, start: Tensor, proximity: Tensor) -> tuple[Tensor, Tensor]:
        """Scaled returns and mean penalties of virtual trajectories, ``[L, B]`` each."""
        penalties = []

        def act(observations: Tensor) -> Tensor:
            actions = self.act(observations, proximity)
            difference = actions - self._behaviour_act(observations)
            penalties.append(difference.square().mean(dim=-1))
            return actions

        returns = self._returns.of(start, act)
        penalty = discounted_sum(penalties, self._config.discount) / self._config.horizon
        return returns, penalty

    def _imitation_loss(self, index: Tensor) -> Tensor:
        """Mean squared distance to logged actions at proximity 0, summed over entries, ``[L]``."""
        observations = self._data.observations(index)
        actions = self.act(observations, torch.zeros_like(observations[..., 0]))
        return lanewise_mean((actions - self._data.actions(index)).square().sum(dim=-1))

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One policy update on all lanes."""
        drawn = self._streams.at(step)
        proximity = drawn["proximity"]
        returns, penalty = self._virtual_losses(drawn["start"], proximity)
        imitation = self._imitation_loss(drawn["clone"])
        mixed = -proximity * returns + (1.0 - proximity) * penalty
        loss = lanewise_mean(mixed) + self._config.eta * imitation
        descend(self._optimizer, loss)
        return {
            "policy/loss": loss.detach(),
            "policy/virtual_return": lanewise_mean((returns * self._returns.scale).detach()),
            "policy/penalty": lanewise_mean(penalty.detach()),
            "policy/imitation_error": imitation.detach() / self._data.action_width,
        }

    # -- what is deployed ------------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._network.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="lion",
    config=Config,
    learner=Learner,
    version=4,
    cost=per_virtual_step(1.4e-5),
    needs=("behaviour_policy", "recurrent_ensemble"),
    transitions=TRANSITIONS,
    takes_proximity=True,
)
