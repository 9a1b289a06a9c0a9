"""WSBC: the policy is searched for in a small box around the weights of the behaviour policy.

Swazinna, Udluft, Hein, Runkler, "Behavior Constraining in Weight Space for Offline Reinforcement
Learning" (2021); thesis 5.2, equations 5.17 to 5.20 and algorithm 2. There is no gradient: a swarm
of particles, each the weights of a policy of the behaviour policy's architecture, maximises

    L(theta) = mean over start states of sum_t gamma^t r_t                               (5.17)

on virtual trajectories of the transition ensemble, every step taking the member of lowest predicted
reward. Every weight stays between ``psi - d`` and ``psi + d``, where ``psi`` is the behaviour
policy's (5.20). An update is an iteration of the swarm: all particles are evaluated on the same
start states, store their best positions and move. The policy of an iteration is the best position
of any particle so far.

Equation 5.21 misprints the velocity (the neighbourhood's best twice, no inertia); here it is 2.57
with the constants of thesis 2.6. The text leaves open and this module decides:

- particle 0 begins as the behaviour policy itself, the others uniformly in the box; the first
  iteration evaluates them where they begin;
- an undefined return is the worst of all; a lane ends only if those of all its particles are;
- no weight changes by more than a tenth of d in an iteration (``velocity_limit``): with the whole d
  the swarm comes as far in 10 to 20 iterations as the thesis's in its 100, and then exploits its
  models on narrow logs; chosen on three datasets by a rule, see docs/results.md;
- start states are drawn once per lane, as LION's from the first 30 steps of trajectories, near
  which policies are evaluated (algorithm 2 says from the log; ``start_window``, ``start_after``);
- the box is on the weights as the behaviour policy's artifact stores them: policies see frames in
  its scaling and are deployed with it;
- ``caution`` is no part of the thesis: a price on leaving the log's support, see
  :mod:`~components.algorithms.parts.caution`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm
from components.algorithms.parts.caution import MEASURES, Caution, check_caution
from components.algorithms.parts.learner import LearnerInputs
from components.algorithms.parts.particle_swarm import Swarm, SwarmRule
from components.algorithms.parts.ranges import check_at_least_one, check_virtual_starts
from components.core.draws import Uniform
from components.core.options import option
from components.core.random_streams import LaneStreams, spawn_generators
from components.data.sizes import DataSizes
from components.data.starts import start_rows
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.transition.model_environment import (
    ModelEnvironment,
    RolloutStep,
    discounted_sum,
)
from components.policies.deployment import KINDS, Layers
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


TRAJECTORIES_AT_ONCE: Final = MappingProxyType({"cpu": 4000, "cuda": 200_000})
"""Virtual trajectories of a chunk: what they need at one step should fit a processor's cache; on a
GPU, where many keep it busy, less than its memory."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """WSBC's settings (thesis 5.2.2 and 2.6)."""

    updates: int = 100  # iterations of the swarm
    box: float = 0.0125  # d, largest change of a weight
    particles: int = 200
    neighbourhood: int = 31  # on the ring, the particle itself and as many on either side
    inertia: float = 0.7298  # w
    own_pull: float = 1.49618  # c1, towards a particle's own best
    ring_pull: float = 1.49618  # c2, towards the neighbourhood's best
    velocity_limit: float = 0.1  # v_max, largest change of a weight in an iteration, in d
    starts: int = 200  # start states of a lane, the same for all particles and iterations
    horizon: int = 100  # steps of a virtual trajectory
    discount: float = 0.97  # gamma
    start_window: int = 30  # start states are steps start_after ... start_window - 1 of each
    start_after: int = 0  # logged trajectory; more than 0 where their past must all be recorded
    caution: float | None = option(None)  # price of leaving the log's support, in mean returns
    caution_by: str = option(MEASURES[0])  # or disagreement, of the members

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "particles", "starts", "horizon", "start_window")
        check_virtual_starts(self.discount, self.start_window, self.start_after)
        if self.neighbourhood % 2 == 0 or not 1 <= self.neighbourhood <= self.particles:
            raise ValueError(
                "neighbourhood must be odd and at most the number of particles, got "
                f"{self.neighbourhood} of {self.particles}."
            )
        if min(self.box, self.own_pull, self.ring_pull) < 0:
            raise ValueError("box, own_pull and ring_pull must not be negative.")
        if not 0 < self.velocity_limit <= 2:
            raise ValueError(
                f"velocity_limit must lie in (0, 2], got {self.velocity_limit}; at 2 a particle "
                "crosses the whole box in one iteration."
            )
        if not 0 <= self.inertia < 1:
            raise ValueError(f"inertia must lie in [0, 1), got {self.inertia}.")
        check_caution(self.caution, self.caution_by)


class Learner(StackedLearner):
    """A stack of WSBC swarms, one lane per (dataset, seed)."""

    updates_per_graph = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device = inputs.data, inputs.data.device
        self.lanes = data.lanes
        behaviours = inputs.fitted("behaviour_policy", Policy)
        self._behaviour = Policy.concatenate(behaviours[0].card, behaviours).to(device)
        ensembles = inputs.fitted("recurrent_ensemble", RecurrentEnsemble)
        self._environment = ModelEnvironment(
            RecurrentTransition(ensembles, device), inputs.dynamics, self._behaviour.frames, device
        )
        starts = self._starts(inputs.keys)
        scaling = self._behaviour.frames
        raw = data.raw_histories(starts)
        scaled = (raw - scaling.mean[:, None, None]) / scaling.scale[:, None, None]
        self._observations = scaled.flatten(2)
        _, past = data.start_states(starts, self._environment.model.memory)
        # The ensemble's hidden state after the recorded frames: the same for all particles.
        self._begun = self._environment.model.begin(past[:, None])
        self._newest = past[:, :, :1]
        self._caution = self._cautious(inputs)
        self._centre = torch.cat(
            [t.flatten(1) for layer in self._behaviour.layers for t in layer], 1
        )
        self._swarm = self._first_swarm(inputs.keys)
        self._networks = {"swarm": self._swarm}
        self._optimizers = {}
        size = tuple(self._swarm.positions.shape[1:])
        self._streams = LaneStreams(
            inputs.keys,
            {
                "own": Uniform(*size),
                "ring": Uniform(*size),
            },
            device,
            block=1,  # a step draws two numbers per weight of every particle
        )

    def _starts(self, keys: Sequence[int]) -> Tensor:
        """Transitions ``[L, S]`` in whose states virtual trajectories start."""
        config, data = self._config, self._data
        window, after = config.start_window, config.start_after
        rows = [
            generator.choice(start_rows(dataset, window, after), size=config.starts)
            for generator, dataset in zip(
                spawn_generators(keys, "start"), data.datasets, strict=True
            )
        ]
        return torch.from_numpy(np.stack(rows)).to(data.device)

    def _cautious(self, inputs: LearnerInputs) -> Caution | None:
        """The support of the logs, what the behaviour policies visit included."""
        config = self._config
        if config.caution is None:
            return None
        caution = Caution(self._data, self._behaviour.frames, config.caution_by)
        returns = torch.tensor(inputs.mean_window_returns, device=self._data.device)
        self._price = config.caution * returns.abs()[:, None]
        with torch.no_grad():
            behaviour = self._behaviour.layers
            steps = self._unroll(1, lambda observations: self._act_by(behaviour, observations))
            caution.familiar(list(steps))
        return caution

    def _first_swarm(self, keys: Sequence[int]) -> Swarm:
        """The behaviour policy, and the other particles uniformly in the box around it."""
        config, centre = self._config, self._centre
        size = (config.particles, centre.shape[1])
        drawn = [g.uniform(-1.0, 1.0, size) for g in spawn_generators(keys, "positions")]
        away = torch.from_numpy(np.stack(drawn)).float().to(centre.device)
        away[:, 0] = 0.0
        rule = SwarmRule(
            config.neighbourhood,
            config.inertia,
            config.own_pull,
            config.ring_pull,
            config.velocity_limit,
        )
        low, high = centre - config.box, centre + config.box
        return Swarm(rule, centre[:, None] + config.box * away, low, high)

    # -- networks ---------------------------------------------------------------------------

    def _layers(self, positions: Tensor) -> Layers:
        """Weights and biases of the policies at ``positions [L, C, D]``, ``L * C`` of them."""
        layers, place = [], 0
        flat = positions.flatten(0, 1)
        for layer in self._behaviour.layers:
            pair = []
            for tensor in layer:
                size = tensor[0].numel()
                part = flat[:, place : place + size]
                pair.append(part.reshape(-1, *tensor.shape[1:]))
                place += size
            layers.append((pair[0], pair[1]))
        return tuple(layers)

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return self._act_by(self._best_layers(), observations)

    def _best_layers(self) -> Layers:
        """Layers of the best policies so far."""
        return self._layers(self._swarm.best[:, None])

    def _act_by(self, layers: Layers, observations: Tensor) -> Tensor:
        """Actions ``[L, C * B, A]`` of C policies a lane, each at B observations in a row."""
        grouped = observations.view(len(layers[0][0]), -1, observations.shape[-1])
        actions = KINDS["tanh"]({"actor": layers}, grouped, None, 0.0)
        return actions.view(*observations.shape[:2], -1)

    # -- fitness ----------------------------------------------------------------------------

    def _returns(self, positions: Tensor) -> Tensor:
        """Mean virtual returns ``[L, C]`` of the policies at ``positions [L, C, D]`` (5.17)."""
        lanes, count, _ = positions.shape
        layers = self._layers(positions)
        rewards: list[Tensor] = []
        kept: list[RolloutStep] = []
        for step in self._unroll(count, lambda observations: self._act_by(layers, observations)):
            rewards.append(step.rewards)
            if self._caution is not None:
                kept.append(step)
        discount = self._config.discount
        returns = discounted_sum(rewards, discount)
        if self._caution is not None:
            returns = returns - self._price * self._caution.excess(kept, discount)
        return returns.view(lanes, count, -1).mean(dim=2)

    def _unroll(self, count: int, act: Callable[[Tensor], Tensor]) -> Iterator[RolloutStep]:
        """Virtual trajectories from all start states, of ``count`` policies a lane."""
        observations, newest = (
            known[:, None].expand(-1, count, *known.shape[1:]).flatten(1, 2)
            for known in (self._observations, self._newest)
        )
        return self._environment.unroll(
            observations,
            newest,
            act,
            self._config.horizon,
            state=self._begun[:, :, None].expand(-1, -1, count, -1).flatten(2),
        )

    @torch.no_grad()
    def _fitness(self) -> Tensor:
        """Mean virtual returns of all particles, ``[L, N]``; chunks of them bound the memory."""
        at_once = TRAJECTORIES_AT_ONCE[self._data.device.type]
        chunk = max(1, at_once // (self.lanes * self._config.starts))
        return torch.cat([self._returns(p) for p in self._swarm.positions.split(chunk, 1)], 1)

    # -- update -----------------------------------------------------------------------------

    @torch.no_grad()
    def update(self, step: int) -> dict[str, Tensor]:
        """One iteration of all swarms."""
        drawn = self._streams.at(step)
        fitness = self._fitness()
        better = self._swarm.remember(fitness)
        self._swarm.move(drawn["own"], drawn["ring"])
        return {
            "policy/virtual_return": self._swarm.best_fitness.amax(dim=1),
            "policy/weight_distance": (self._swarm.best - self._centre).abs().mean(dim=1),
            "swarm/virtual_return": _defined_mean(fitness),
            "swarm/improved_share": better.float().mean(dim=1),
        }

    # -- what is deployed ------------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The best policies so far, one per lane; at first the behaviour policies."""
        return Policy.of_networks(card, {"actor": self._best_layers()}, self._behaviour.frames)


def _defined_mean(fitness: Tensor) -> Tensor:
    """Mean ``[L]`` of the defined ones of ``fitness [L, N]``; undefined if all are.

    A lane whose curves are undefined ends. A particle that leads where the ensemble fails has lost,
    and the others search on.
    """
    return fitness.where(fitness.isfinite(), torch.nan).nanmean(dim=1)


def _cost(config: Config, sizes: DataSizes) -> float:
    steps = config.updates * config.particles * config.starts * config.horizon
    return 9e-7 * float(steps)


ALGORITHM: Final = Algorithm(
    name="wsbc",
    config=Config,
    learner=Learner,
    version=4,
    cost=_cost,
    needs=("behaviour_policy", "recurrent_ensemble"),
)
