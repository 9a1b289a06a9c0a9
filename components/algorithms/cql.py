"""CQL: soft actor-critic whose values are pushed down for actions that were not logged.

Kumar, Zhou, Tucker, Levine, "Conservative Q-Learning for Offline Reinforcement Learning" (2020), in
the form of the authors' code. Per update, on one batch, with N = 10:

    temperature: log_alpha descends -log_alpha (log pi(a~ | s) - A)        (target entropy -A)
    actor:   mean [alpha log pi(a~ | s) - min_j Q_j(s, a~)],  a~ ~ pi; in the warm-up
             mean [alpha log pi(a~ | s) - log pi(a | s)]
    y        = r + gamma (1 - terminal) min_j Q_target_j(s', a'),  a' ~ pi, no entropy term
    L_j      = w [log sum exp over actions tried at s - mean Q_j(s, a)]
    critics: sum_j mean (Q_j(s, a) - y)^2 + L_j
    targets <- tau online + (1 - tau) target

CQL(H), ``variant=h``: tried are N uniform actions, N of pi(s) and N of pi(s'), each value less its
log density. CQL(rho), ``variant=rho``: the same and the logged action, without densities; that is
the authors' code, not the paper's expression. ``lagrange=TAU`` learns a multiplier of
``L_j - TAU`` instead of taking it as 1. Deployed is tanh of the mean.

Where references disagree: w = 5 without Lagrange and an actor rate of 1e-4 (the authors' README;
the paper used 3e-5 and Lagrange), three layers of 256, a warm-up of 40,000 updates of a
million, here the same share of the budget. The squared error carries no factor 1/2, so w is twice
the paper's.

Deviations: the temperature's and actor's steps come before the critics' (the authors' order cannot
run on today's PyTorch); initial weights are PyTorch's; frames are standardised; logged actions are
clipped to +-0.999 inside densities. The end of a logged trajectory is a time-out and is
bootstrapped through. gamma and the budget of 300 epochs of 1,000 updates are the thesis's (5.1.2).
"""

import copy
import math
from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    Scalars,
    adam_each,
    bootstrapped,
    descend,
    gather_gradients,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.draws import Normal, Uniform
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.networks import Critics, TanhGaussian, lane_groups, lanewise_mean, polyak_update
from components.networks.gaussian import log_density, raw_actions
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]

ACTION_MARGIN = 1e-3  # logged actions are kept this far from the bounds inside densities
LARGEST_MULTIPLIER = 1e6


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' recommended settings, with the thesis's discount and budget."""

    updates: int = 300_000
    hidden: tuple[int, ...] = (256, 256, 256)  # layers of actor and critics
    actor_learning_rate: float = 1e-4  # Adam, actor and temperature
    learning_rate: float = 3e-4  # Adam, critics and multiplier
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    weight: float = 5.0  # w, of the conservative term
    variant: Literal["h", "rho"] = "h"
    lagrange: float | None = None  # gap that the learned multiplier allows; None: no multiplier
    tried_actions: int = 10  # N, of each kind
    cloning: float = 0.04  # warm-up: first share of the updates, the actor imitates the log

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "tried_actions", "hidden")
        check_bootstrapping(self.discount, self.target_rate)
        if min(self.actor_learning_rate, self.learning_rate) <= 0:
            raise ValueError("learning rates must be positive.")
        if min(self.weight, self.lagrange or 0) < 0:
            raise ValueError("weight and lagrange must not be negative.")
        if not 0 <= self.cloning <= 1 or self.variant not in ("h", "rho"):
            raise ValueError("cloning must lie in [0, 1] and variant be h or rho.")


class Learner(StackedLearner):
    """A stack of CQL learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        self.lanes = data.lanes
        seen, acted = data.observation_width, data.action_width
        self._actor = TanhGaussian(keys, "actor", (seen, *config.hidden, acted)).to(device)
        self._critics = Critics(keys, seen, acted, config.hidden).to(device)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        # With 31 actions a state, the activations of all lanes overflow the cache of a CPU.
        groups = self.lanes if device.type == "cpu" else 1
        self._groups = lane_groups(self._critics, self.lanes, groups)
        self._log_temperature = Scalars(self.lanes, 0.0).to(device)
        self._networks = {
            "actor": self._actor,
            "critics": self._critics,
            "critics_target": self._critics_target,
            "log_temperature": self._log_temperature,
        }
        rates = {
            "actor": config.actor_learning_rate,
            "log_temperature": config.actor_learning_rate,
            "critics": config.learning_rate,
        }
        if config.lagrange is not None:
            self._log_multiplier = Scalars(self.lanes, 0.0).to(device)
            self._networks["log_multiplier"] = self._log_multiplier
            rates["log_multiplier"] = config.learning_rate
        self._optimizers = adam_each(self._networks, rates)
        batch, tried = config.batch, (config.batch, config.tried_actions, acted)
        self._streams = LaneStreams(
            keys,
            {
                "row": data.row_draw(batch),
                "actor": Normal(batch, 1, acted),
                "target": Normal(batch, 1, acted),
                "here": Normal(*tried),
                "next": Normal(*tried),
                "uniform": Uniform(*tried, low=-1.0),
            },
            device,
        )

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations)[0])

    # -- losses -----------------------------------------------------------------------------

    def _actor_loss(
        self, batch: Batch, noise: Tensor, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Step the temperature; actor's loss ``[L]`` at the new one, and metrics."""
        mean, log_std = self._actor(batch.observations)
        actions, _, density = self._actor.draw((mean, log_std), noise)
        entropy_cost = lanewise_mean(density)
        surplus = entropy_cost.detach() - actions.shape[-1]  # log density above target entropy's
        descend(self._optimizers["log_temperature"], -self._log_temperature.value * surplus)
        loss = self._log_temperature.value.detach().exp() * entropy_cost
        metrics = {"actor/saturated_share": saturation(actions)}
        if self.branch(step):
            logged = raw_actions(batch.actions, ACTION_MARGIN)
            loss = loss - lanewise_mean(log_density(mean, log_std, logged))
        else:
            values = self._critics.least(batch.observations, actions.squeeze(2))
            loss = loss - lanewise_mean(values)
            metrics["critic/value_magnitude"] = lanewise_mean(values.detach().abs())
        return loss, metrics | {"actor/loss": loss.detach()}

    @torch.no_grad()
    def _tried(self, batch: Batch, drawn: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Targets ``[L, B]``, log densities ``[L, B, 3N]`` of the actions tried, and the actions.

        The actions ``[L, B, 1 + 3N, A]`` begin with the logged one. One pass of the actor gives its
        distributions at states and next states, one draw both kinds of its actions.
        """
        states = torch.cat([batch.observations, batch.next_observations], dim=1)
        distributions = self._actor(states)
        noise = torch.cat([drawn["here"], drawn["next"]], dim=1)
        actions, _, densities = self._actor.draw(distributions, noise)
        mean, log_std = (parameters.chunk(2, dim=1)[1] for parameters in distributions)
        action, _ = self._actor.sample((mean, log_std), drawn["target"])
        values = self._critics_target(batch.next_observations, action.squeeze(2)).amin(dim=1)
        targets = bootstrapped(batch, self._config.discount, values)
        uniform, own, density = drawn["uniform"], actions.chunk(2, 1), densities.chunk(2, 1)
        of_uniform = torch.full_like(density[0], -uniform.shape[-1] * math.log(2.0))
        tried = torch.cat([batch.actions[:, :, None], uniform, *own], dim=2)
        return targets, torch.cat([of_uniform, *density], dim=2), tried

    def _critic_losses(
        self, critics: Critics, batch: Batch, targets: Tensor, density: Tensor, tried: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean squared errors and conservative terms of both critics, ``[L, 2]`` each."""
        values = critics.over_actions(batch.observations, tried)  # [L, 2, B, 1 + 3N]
        logged, others = values.split([1, density.shape[-1]], dim=-1)
        logged = logged.squeeze(-1)
        errors = mse_loss(logged, targets[:, None].expand_as(logged), reduction="none").mean(dim=2)
        if self._config.variant == "h":
            pushed = torch.logsumexp(others - density[:, None], dim=-1)
        else:
            pushed = torch.logsumexp(values, dim=-1)
        return errors, self._config.weight * (pushed - logged).mean(dim=2)

    def _weigh(self, errors: Tensor, gaps: Tensor, lanes: slice) -> Tensor:
        """Loss ``[L]`` of the critics of some lanes."""
        allowed = self._config.lagrange
        if allowed is None:
            return (errors + gaps).sum(dim=1)
        multiplier = self._log_multiplier.value.detach()[lanes].exp().clamp(max=LARGEST_MULTIPLIER)
        return (errors + multiplier[:, None] * (gaps - allowed)).sum(dim=1)

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> bool:
        """Whether this is the warm-up, in which the actor imitates the log."""
        return step < round(self._config.cloning * self._config.updates)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update of temperature, actor, critics and targets on all lanes."""
        drawn = self._streams.at(step)
        batch = self._data.batch(drawn["row"])
        actor_loss, metrics = self._actor_loss(batch, drawn["actor"], step)
        descend(self._optimizers["actor"], actor_loss)
        metrics |= self._critic_step(batch, *self._tried(batch, drawn))
        polyak_update([(self._critics_target, self._critics)], self._config.target_rate)
        return metrics | {"actor/temperature": self._log_temperature.value.detach().exp()}

    def _critic_step(
        self, batch: Batch, targets: Tensor, density: Tensor, tried: Tensor
    ) -> dict[str, Tensor]:
        """Step the critics, and the multiplier where one is learned."""
        parts = []
        for lanes, critics in self._groups:
            critics.zero_grad(set_to_none=True)
            errors, gaps = self._critic_losses(
                critics, batch.lanes(lanes), targets[lanes], density[lanes], tried[lanes]
            )
            loss = self._weigh(errors, gaps, lanes)
            loss.backward(torch.ones_like(loss))
            parts.append([each.detach() for each in (loss, errors, gaps)])
        gather_gradients(self._critics, [critics for _, critics in self._groups])
        self._optimizers["critics"].step()
        loss, errors, gaps = (torch.cat(each) for each in zip(*parts, strict=True))
        if self._config.lagrange is not None:
            multiplier = self._log_multiplier.value.exp().clamp(max=LARGEST_MULTIPLIER)
            ascent = -multiplier * (gaps - self._config.lagrange).mean(dim=1)
            descend(self._optimizers["log_multiplier"], ascent)
        return {
            "critic/loss": loss,
            "critic/squared_error": errors.sum(dim=1),
            "critic/conservative_gap": gaps.mean(dim=1),
            "critic/target_mean": lanewise_mean(targets),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(
            card, {"actor": self._actor.mean_network()}, self._data.frame_scaling
        )


ALGORITHM: Final = Algorithm(
    name="cql",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(5.8e-4),
    frame_epsilon=1e-3,
)
