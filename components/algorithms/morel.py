"""MOReL: natural policy gradients in a model environment that halts where its models disagree.

Kidambi et al., "MOReL: Model-Based Offline Reinforcement Learning" (2020); thesis equation 2.50.
The policy, an unsquashed Gaussian, is pretrained on the logged actions; then, per update and lane:

    roll 50 trajectories of H steps out through each of the K residual members, with drawn actions
    disc(s, a) = max_ij ||f_i(s, a) - f_j(s, a)||;  unknown where above mean + beta std of the log's
    the first unknown step enters HALT: reward (min r - offset) / (1 - gamma), terminal
    advantages by GAE from a baseline V(s, t), whitened; g = mean[A grad log pi]
    x = (F + damping)^-1 g by conjugate gradients;  pi moves by sqrt(delta / (g x)) x
    V: one epoch on the discounted returns

Deployed is the mean action, clipped to [-1, 1].

The authors' paper and code disagree; taken is the paper's process with the code's planner. HALT is
absorbing and pays the least logged reward less an offset, or `halt_reward` where it is given; the
code cuts trajectories off with an extra of 0 (so does `halt_reward=0`) and, by a slip, bootstraps
from the network after the cut, which never happens here. The threshold is mean + beta std; in the
code it is the log's maximum over a coefficient. The paper pays the unknown step's own reward before
those of HALT; here that reward depends on the next frame, which is unknown, so HALT pays from that
step on.

disc is measured on the standardised learned features of the newest frame. On the Industrial
Benchmark beta = 5 of the authors' 0, 5 ... 25: on `mediocre-0.4` the log's largest disc lies 9.8
deviations above its mean, so that larger ones would find the whole log known; 5 cuts one logged
step of 700, 3 one of 80, with which most logged windows of 100 steps would halt. Rewards are
divided by 100 already: an offset of 1 is about one deviation of a logged reward (the authors' 30 to
200 are for MuJoCo). Half the trajectories begin where logged ones do, whose histories are padded,
half at any logged state. Actions are clamped to the box inside the model (the authors' environment
does it). Falls have no rule of their own: the models have learned that they are absorbing.

Deviations: gamma is the thesis's 0.97 and H the evaluation's 100 steps (0.999 and 500). Conjugate
gradients start at zero (at g), which makes the step's length exact. F is estimated from a random
part of the live samples: with 5,000 of 20,000 the true divergence was 1.0 to 1.4 times as large as
with all, for a third less time. Time enters the baseline as a share of H, targets as multiples of
the log's mean return, and a trajectory's end is bootstrapped from the state after its last step
(from the last one). Baseline batches hold live samples only, repeated where these are few;
trajectories shorter than five steps count. Pretraining takes a fixed number of updates, 5 epochs of
100,000 transitions. The authors keep the policy of the best real evaluation; nothing is evaluated
here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.advantages import Baseline, discounted_returns
from components.algorithms.parts.algorithm import Algorithm, per_virtual_step
from components.algorithms.parts.halting import Rollouts, by_sample, live_samples
from components.algorithms.parts.learner import LearnerInputs, descend, saturation
from components.algorithms.parts.natural_gradient import (
    LOG_STD_RANGE,
    FisherProduct,
    GaussianPolicy,
    natural_step,
    policy_gradient,
)
from components.algorithms.parts.pessimistic_mdp import Detector, PessimisticMDP
from components.algorithms.parts.ranges import check_at_least_one
from components.core.draws import Choice, Draw, Normal, Order
from components.core.options import option
from components.core.random_streams import LaneStreams
from components.data.sizes import DataSizes
from components.data.starts import start_rows
from components.models.mlp_ensemble.ensemble import MLPEnsemble, MLPTransition
from components.models.transition.model_environment import ModelEnvironment
from components.networks import lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]

WEIGHT_DECAY = 1e-3  # of the baseline
PORTION = 2000  # samples a lane at once in the policy gradient, which limits the memory


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and the evaluation's horizon."""

    updates: int = 500  # natural gradient steps, after pretraining
    cloning: int = 1950  # pretraining updates, towards the logged actions
    hidden: tuple[int, ...] = (64, 64)  # policy layers
    value_hidden: tuple[int, ...] = (128, 128)  # baseline layers
    learning_rate: float = 1e-3  # Adam, pretraining and baseline
    batch: int = 256  # of pretraining and baseline
    trajectories: int = 50  # virtual ones per member and update
    horizon: int = 100  # H, steps of a virtual trajectory
    discount: float = 0.97  # gamma
    trace: float = 0.97  # lambda of the advantages
    beta: float = 5.0  # deviations above the log's mean disagreement that are still known
    halt_offset: float = 1.0  # HALT's reward below the log's least, in the log's units
    initial_log_std: float = -0.25  # of actions
    step_size: float = 0.02  # delta, twice the divergence of a step
    damping: float = 1e-3  # of the Fisher matrix
    iterations: int = 20  # of conjugate gradients
    fisher_samples: int = 5000  # live samples a lane behind the Fisher matrix
    halt_reward: float | None = option(None)  # of HALT, in place of the log's least less the offset

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "trajectories", "horizon", "iterations")
        check_at_least_one(self, "fisher_samples", "hidden", "value_hidden")
        if not 0 < self.discount < 1 or not 0 <= self.trace <= 1:
            raise ValueError("discount must lie in (0, 1) and trace in [0, 1].")
        if min(self.learning_rate, self.step_size, self.damping) <= 0:
            raise ValueError("learning_rate, step_size and damping must be positive.")
        if self.cloning < 0 or self.halt_offset < 0:
            raise ValueError("cloning and halt_offset must not be negative.")
        low, high = LOG_STD_RANGE
        if not low <= self.initial_log_std <= high:
            raise ValueError(f"initial_log_std must lie in [{low:g}, {high:g}].")


class Learner(StackedLearner):
    """A stack of MOReL learners, one lane per (dataset, seed)."""

    updates_per_graph = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        self.lanes, self.pretraining = data.lanes, config.cloning
        ensembles = inputs.fitted("residual_ensemble", MLPEnsemble)
        model = MLPTransition(ensembles, data.frame_scaling, device)
        environment = ModelEnvironment(model, inputs.dynamics, data.frame_scaling, device)
        self._detector = Detector(environment, data, config.beta).to(device)
        followed = torch.arange(model.members, device=device).repeat_interleave(config.trajectories)
        self._batch = len(followed)  # B
        halting = [
            float(dataset.rewards.min()) - config.halt_offset
            if config.halt_reward is None
            else config.halt_reward
            for dataset in data.datasets
        ]
        self._mdp = PessimisticMDP(
            environment,
            self._detector,
            followed.expand(config.horizon, self.lanes, -1),
            torch.tensor(halting, device=device),
            config.discount,
        )
        usual = torch.tensor(inputs.mean_window_returns, device=device).abs()
        seen, acted, rate = data.observation_width, data.action_width, config.learning_rate
        sizes = (seen, *config.hidden, acted)
        self._actor = GaussianPolicy(keys, sizes, config.initial_log_std).to(device)
        self._critic = Baseline(keys, seen, config.value_hidden, config.horizon, usual).to(device)
        self._networks = {"actor": self._actor, "critic": self._critic, "detector": self._detector}
        self._optimizers = {
            "actor": adam(list(self._actor.stack.parameters()), rate),
            "critic": adam(list(self._critic.parameters()), rate, WEIGHT_DECAY),
        }
        self._pretraining_streams = LaneStreams(keys, {"row": data.row_draw(config.batch)}, device)
        # The draws of more than one update at a time would need too much memory.
        self._streams = LaneStreams(keys, self._draws(), device, block=1)

    def _draws(self) -> dict[str, Draw]:
        batch, horizon, data = self._batch, self._config.horizon, self._data
        begins = [start_rows(dataset, 1) for dataset in data.datasets]
        half = (batch + 1) // 2
        return {
            "begin": Choice(begins, half),
            "anywhere": data.row_draw(half),
            "noise": Normal(horizon, batch, data.action_width),
            "order": Order(horizon * batch),
        }

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        mean: Tensor = self._actor(observations)
        return mean.clamp(-1.0, 1.0)

    # -- virtual trajectories -----------------------------------------------------------------

    def _starts(self, drawn: Mapping[str, Tensor]) -> Tensor:
        """Rows ``[L, B]``: of each member's, every other one begins where a logged one does."""
        both = torch.stack([drawn["begin"], drawn["anywhere"]], dim=-1)
        return both.flatten(1)[:, : self._batch]

    @torch.no_grad()
    def _roll_out(self, start: Tensor, noise: Tensor) -> Rollouts:
        """Trajectories from logged states ``start [L, B]`` with ``noise [L, T, B, A]``."""
        config = self._config
        draws, saturated = iter(noise.unbind(dim=1)), []

        def act(observations: Tensor) -> Tensor:
            actions = self._actor.draw(observations, next(draws)).clamp(-1.0, 1.0)
            saturated.append(saturation(actions))
            return actions

        past = self._data.start_states(start, self._mdp.memory)
        states, ended = self._mdp.roll_out(*past, act)
        every = torch.arange((config.horizon + 1) * self._batch, device=start.device)
        values = [
            self._critic(states.observations(rows), rows // self._batch)
            for rows in every.expand(self.lanes, -1).split(self._batch, dim=1)
        ]
        return Rollouts(
            states,
            noise.flatten(1, 2),
            torch.stack(values),
            ended,
            discounted_returns(ended.rewards, ended.continues, config.discount),
            torch.stack(saturated).mean(dim=0),
        )

    # -- policy and baseline --------------------------------------------------------------------

    def _climb(self, rolled: Rollouts, live: Tensor) -> None:
        """One natural gradient step of all policies."""
        config, states = self._config, rolled.states
        weights = rolled.weights(config.discount, config.trace)
        every = torch.arange(weights.shape[1], device=weights.device).expand(self.lanes, -1)
        portions = zip(
            every.split(PORTION, dim=1),
            rolled.noise.split(PORTION, dim=1),
            weights.split(PORTION, dim=1),
            strict=True,
        )
        gradient = policy_gradient(
            self._actor, ((states.observations(n), *o) for n, *o in portions)
        )
        some = states.observations(live[:, : config.fisher_samples])
        step = natural_step(
            FisherProduct(self._actor, some),
            gradient,
            size=config.step_size,
            damping=config.damping,
            iterations=config.iterations,
        )
        self._actor.advance(step)

    def _fit_baseline(self, rolled: Rollouts, live: Tensor) -> Tensor:
        """One epoch on the returns; the mean loss ``[L]``."""
        returns, losses = by_sample(rolled.returns), []
        for rows in live.split(self._config.batch, dim=1):
            seen = rolled.states.observations(rows)
            loss = self._critic.loss(seen, rows // self._batch, returns.gather(1, rows))
            descend(self._optimizers["critic"], loss)
            losses.append(loss.detach())
        return torch.stack(losses).mean(dim=0)

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> str:
        """Phase: pretraining, then the policy gradient, whose tensors always have one shape."""
        return "pretraining" if step < self.pretraining else "policy"

    def stage(self, first: int, count: int) -> None:
        """Tell CUDA graphs which step comes next."""
        if first < self.pretraining:
            self._pretraining_streams.stage(first, count)
        else:
            self._streams.stage(first - self.pretraining, count)

    def draw(self, first: int, count: int) -> None:
        """Draw the numbers of the step that was staged."""
        streams = self._pretraining_streams if first < self.pretraining else self._streams
        streams.draw(count)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on all lanes: of pretraining at first, then a natural gradient step."""
        if step < self.pretraining:
            return self._pretrain(self._pretraining_streams.at(step)["row"])
        drawn = self._streams.at(step - self.pretraining)
        rolled = self._roll_out(self._starts(drawn), drawn["noise"])
        ended, halted = rolled.ended, rolled.ended.halts.any(dim=0).float()
        live = live_samples(by_sample(ended.alive), drawn["order"])
        self._climb(rolled, live)
        return {
            "actor/virtual_return": lanewise_mean(rolled.returns[0]),
            "actor/halted_share": lanewise_mean(halted),
            "actor/steps_before_halt": lanewise_mean(ended.alive.sum(dim=0) - halted),
            "actor/std": self._actor.log_std.detach().exp().mean(dim=(1, 2)),
            "actor/saturated_share": rolled.saturated,
            "critic/loss": self._fit_baseline(rolled, live),
            "critic/value_magnitude": lanewise_mean(rolled.values.abs().transpose(0, 1)),
            "detector/threshold": self._detector.threshold.clone(),
            "detector/known_share": self._detector.known_share.clone(),
        }

    def _pretrain(self, rows: Tensor) -> dict[str, Tensor]:
        means = self._actor(self._data.observations(rows))
        loss = lanewise_mean((means - self._data.actions(rows)).square())
        descend(self._optimizers["actor"], loss)
        return {"actor/imitation_error": loss.detach()}

    # -- what is deployed ------------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(
            replace(card, kind="clipped_tanh_layers"),
            {"actor": self._actor.stack.affine()},
            self._data.frame_scaling,
        )


def _cost(config: Config, sizes: DataSizes) -> float:
    return per_virtual_step(2.3e-4)(config, sizes) + 2.2e-3 * float(config.cloning)


ALGORITHM: Final = Algorithm(
    name="morel",
    config=Config,
    learner=Learner,
    version=2,
    cost=_cost,
    needs=("residual_ensemble",),
)
