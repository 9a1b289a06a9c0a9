"""MOOSE: model-based offline policy search with ensembles and a reconstruction penalty.

Swazinna, Udluft, Runkler, "Overcoming Model Bias for Robust Offline Deep Reinforcement Learning"
(2021); thesis 5.1, equations 5.4 to 5.15 and algorithm 1. The policy is trained purely on virtual
trajectories of a learned ensemble of one-step models. Per update and lane:

    draw B start states from the whole log
    every one of K members rolls pi out for H steps on its own
    R_k  = sum_t gamma^t r_t                               (trajectory of member k)
    R    = eta min_k R_k + (1 - eta) mean_k R_k            (per start state, 5.15)
    P    = mean_k sum_t gamma_P^t mean_d (pi - a')_d^2     (a' decoded from a sample of q(z | s, a))
    loss = mean[-lambda R + (1 - lambda) P]                (5.14)

The reconstruction error is large for actions and states unlike the logged ones; the gradient
reaches the policy through both. Models and autoencoder are not trained further.

What the thesis leaves open: errors are accumulated "similarly to the rewards", so they are
discounted, though 5.13 prints no discount. (Undiscounted, an untrained policy, whose drifting
trajectories end where nothing was logged, has a gradient six times as long on mediocre-0.4, and the
first steps at the thesis's rate overshoot.) Action dimensions are averaged, as in the autoencoder's
own loss and in LION. Rewards are not normalised; those of the Industrial Benchmark are stored
divided by 100. The optimiser is plain gradient descent there and Adam at 1e-5 on MuJoCo, as the
experimental section says (the method section names Adam).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_virtual_step
from components.algorithms.parts.learner import (
    LearnerInputs,
    descend,
    gather_gradients,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one
from components.core.draws import Normal
from components.core.normaliser import Normaliser
from components.core.options import option
from components.core.random_streams import LaneStreams, spawn_generators
from components.models.action_vae import ActionReconstruction, ActionVAE
from components.models.mlp_ensemble.ensemble import MLPEnsemble, MLPTransition
from components.models.transition.model_environment import ModelEnvironment, discounted_sum
from components.networks import StackedMLP, lane_groups, lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner", "mixed_return"]

LANES_AT_ONCE = {"cpu": 1, "cuda": 16}  # trajectories keep 0.6 GiB a lane for the gradient
CLONING_RATE: Final = 1e-3  # Adam; far from a random policy's beginning 1e-5 would take for ever
CLONING_BATCH: Final = 256
DRAWN_AT_ONCE = 5  # updates; every one needs a normal number per virtual step and latent

Optimize = Callable[[Sequence[Tensor], float], torch.optim.Optimizer]
OPTIMIZERS: Final = MappingProxyType[str, Optimize]({"sgd": torch.optim.SGD, "adam": adam})


@dataclass(frozen=True, kw_only=True)
class Config:
    """MOOSE's settings (thesis 5.1.2)."""

    updates: int = 1000
    hidden: tuple[int, ...] = (400, 300)  # policy layers
    optimizer: str = "sgd"  # plain, for the Industrial Benchmark; adam for MuJoCo
    learning_rate: float = 1e-4  # 1e-5 for MuJoCo
    trajectories: int = 100  # B, start states per update, each continued by every member
    horizon: int = 100  # H, steps of a virtual trajectory
    discount: float = 0.97  # gamma
    penalty_discount: float = 0.97  # gamma_P, of later steps' errors
    return_weight: float = 0.01  # lambda, against the penalty's 1 - lambda
    minimum_weight: float = 0.5  # eta, of the least member's return against the mean's 1 - eta
    cloning: int = option(0)  # updates towards the logged actions, before all others

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "hidden", "trajectories", "horizon")
        if self.learning_rate <= 0 or not all(
            0 < d <= 1 for d in (self.discount, self.penalty_discount)
        ):
            raise ValueError(
                "learning_rate must be positive and discount and penalty_discount lie in (0, 1]."
            )
        if self.cloning < 0:
            raise ValueError(f"cloning must not be negative, got {self.cloning}.")
        if not 0 <= self.return_weight <= 1 or not 0 <= self.minimum_weight <= 1:
            raise ValueError("return_weight and minimum_weight must lie in [0, 1].")
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(
                f"optimizer must be {' or '.join(OPTIMIZERS)}, got {self.optimizer!r}."
            )


def mixed_return(returns: Tensor, minimum_weight: float) -> Tensor:
    """Estimates ``[L, B]`` from the members' trajectory returns ``[L, K, B]`` (equation 5.15)."""
    least = returns.min(dim=1).values
    return minimum_weight * least + (1.0 - minimum_weight) * returns.mean(dim=1)


@dataclass(frozen=True)
class _Part:
    """Some lanes: their policies, model environment and autoencoders."""

    lanes: slice
    actor: StackedMLP
    environment: ModelEnvironment
    reconstruct: ActionReconstruction


class Learner(StackedLearner):
    """A stack of MOOSE policies, one lane per (dataset, seed)."""

    updates_per_graph = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device = inputs.data, inputs.data.device
        self.lanes = data.lanes
        sizes = (data.observation_width, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(inputs.keys, "policy"), sizes).to(device)
        self._networks = {"policy": self._actor}
        learned = list(self._actor.parameters())
        self._optimizers = {"policy": OPTIMIZERS[config.optimizer](learned, config.learning_rate)}
        self.pretraining = config.cloning
        if self.pretraining:
            self._optimizers["cloning"] = adam(learned, CLONING_RATE)
        cloned = {"row": data.row_draw(CLONING_BATCH)}
        self._cloning_streams = LaneStreams(inputs.keys, cloned, device)
        ensembles = inputs.fitted("deterministic_ensemble", MLPEnsemble)
        autoencoders = inputs.fitted("action_vae", ActionVAE)
        at_once = LANES_AT_ONCE.get(device.type, 1)
        self._parts = []
        for lanes, actor in lane_groups(self._actor, self.lanes, -(-self.lanes // at_once)):
            seen = data.frame_scaling
            scaling = Normaliser(seen.mean[lanes], seen.scale[lanes])
            model = MLPTransition(ensembles[lanes], scaling, device)
            environment = ModelEnvironment(model, inputs.dynamics, scaling, device)
            reconstruct = ActionReconstruction(autoencoders[lanes], scaling, device)
            self._parts.append(_Part(lanes, actor, environment, reconstruct))
        acting = ensembles[0].members * config.trajectories
        latent = self._parts[0].reconstruct.latent
        self._streams = LaneStreams(
            inputs.keys,
            {
                "start": data.row_draw(config.trajectories),
                "latent": Normal(config.horizon, acting, latent),
            },
            device,
            block=DRAWN_AT_ONCE,
        )

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return torch.tanh(self._actor(observations))

    # -- losses -----------------------------------------------------------------------------

    def _virtual(
        self, part: _Part, observations: Tensor, past: Tensor, latent: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns and penalties of virtual trajectories.

        Args:
            part: Some lanes.
            observations: ``[L, B, H * F]`` in their start states.
            past: ``[L, B, G, M]`` model frames up to these, as logged.
            latent: Standard normal ``[L, T, K * B, Z]``.

        Returns:
            Discounted returns and penalties of every member's trajectories, ``[L, K, B]``
            each, and the share of action entries on a bound ``[L]``.
        """
        penalties: list[Tensor] = []
        saturated: list[Tensor] = []

        def act(observations: Tensor) -> Tensor:
            actions = torch.tanh(part.actor(observations))
            rebuilt = part.reconstruct(observations, actions, latent[:, len(penalties)])
            penalties.append((actions - rebuilt).square().mean(dim=-1))
            saturated.append(saturation(actions))
            return actions

        steps = part.environment.unroll(observations, past, act, self._config.horizon, "isolated")
        returns = discounted_sum([step.rewards for step in steps], self._config.discount)
        penalty = discounted_sum(penalties, self._config.penalty_discount)
        by_member = (len(returns), -1, past.shape[1])
        return returns.view(by_member), penalty.view(by_member), torch.stack(saturated).mean(dim=0)

    def _loss(
        self, part: _Part, observations: Tensor, past: Tensor, latent: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss ``[L]`` of some lanes, and metrics; arguments as in :meth:`_virtual`."""
        weight = self._config.return_weight
        returns, penalty, saturated = self._virtual(part, observations, past, latent)
        estimate = lanewise_mean(mixed_return(returns, self._config.minimum_weight))
        cost = lanewise_mean(penalty)
        loss = -weight * estimate + (1.0 - weight) * cost
        metrics = {
            "policy/loss": loss,
            "policy/return_estimate": estimate,
            "policy/virtual_return": lanewise_mean(returns),
            "policy/least_virtual_return": lanewise_mean(returns.amin(dim=1)),
            "policy/penalty": cost,
            "policy/saturated_share": saturated,
        }
        return loss, {name: value.detach() for name, value in metrics.items()}

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> str:
        """Phase: cloning, then the virtual trajectories."""
        return "cloning" if step < self.pretraining else "policy"

    def stage(self, first: int, count: int) -> None:
        """Tell CUDA graphs which step comes next."""
        if first < self.pretraining:
            self._cloning_streams.stage(first, count)
        else:
            self._streams.stage(first - self.pretraining, count)

    def draw(self, first: int, count: int) -> None:
        """Draw the numbers of the step that was staged."""
        (self._cloning_streams if first < self.pretraining else self._streams).draw(count)

    def update(self, step: int) -> dict[str, Tensor]:
        """One policy update on all lanes, part by part: together they would fill the memory."""
        if step < self.pretraining:
            return self._clone(self._cloning_streams.at(step)["row"])
        drawn = self._streams.at(step - self.pretraining)
        memory = self._parts[0].environment.model.memory
        given = (*self._data.start_states(drawn["start"], memory), drawn["latent"])
        found = []
        for part in self._parts:
            part.actor.zero_grad(set_to_none=True)
            loss, metrics = self._loss(part, *(tensor[part.lanes] for tensor in given))
            loss.sum().backward()
            found.append(metrics)
        gather_gradients(self._actor, [part.actor for part in self._parts])
        self._optimizers["policy"].step()
        return {name: torch.cat([metrics[name] for metrics in found]) for name in found[0]}

    def _clone(self, rows: Tensor) -> dict[str, Tensor]:
        actions = self.act(self._data.observations(rows))
        loss = lanewise_mean((actions - self._data.actions(rows)).square().mean(dim=-1))
        descend(self._optimizers["cloning"], loss)
        return {"policy/imitation_error": loss.detach()}

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(card, {"actor": self._actor.affine()}, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="moose",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_virtual_step(2.7e-4),
    needs=("action_vae", "deterministic_ensemble"),
)
