"""MOPO: soft actor-critic on short virtual trajectories, penalised for the model's uncertainty.

Yu et al., "MOPO: Model-based Offline Policy Optimization" (2020), in the form of the authors' code;
thesis chapter 6.3 sweeps its penalty. Every ``rollout_every`` updates and once before the first,
the current policies are rolled out from recorded states drawn uniformly from the log, for
``rollout_length`` steps through a Gaussian ensemble. At every step and in every trajectory

    a  ~ pi(s)
    s' ~ the Gaussian of an elite, drawn anew for each
    u  = max over all members k of ||std_k(s, a)||
    stored reward = r(s') - lambda u

A trajectory ends where the next state is a fall. The authors have a hand-written function for each
task; here its ranges are on the dataset's card, see :mod:`~components.algorithms.parts.falls`, and
no other algorithm uses them. Transitions are drawn uniformly from all that are in the ring.

The ring keeps the last ``retained_rollouts`` roll-outs. An update is one step of
:mod:`~components.algorithms.parts.soft_actor_critic` on a batch of which a share ``real_ratio`` was
logged, with its rewards as they are, and the rest is virtual.

Where references disagree: the authors' rates of 3e-4 and target entropy -3 (there for all tasks,
here it is -A), not 1e-4 with a decay; the penalty over all members, not the elites alone; rewards
of the sampled frame, not of the mean. Authors do not clip predictions to the range of the data, so
``free`` is the default and ``data`` an option; the share that lies outside is logged either way.

Known features follow from the action exactly and the rest of a history is a shift, so the
deviations are those of the learned features, in units of a standardised target (raw units differ by
orders of magnitude). Where the reward is a known function of the new frame, as on the Industrial
Benchmark, it is not predicted beside it. Of 256 transitions the authors' code takes int(12.8)
logged ones, here they are rounded.

Deviations: initial weights are PyTorch's; frames are standardised. gamma and the 100 epochs of
1,000 updates are the thesis's; it does not say how long its roll-outs were.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.falls import healthy_ranges, steps_before_fall
from components.algorithms.parts.learner import LearnerInputs
from components.algorithms.parts.model_buffer import ModelBuffer
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.algorithms.parts.soft_actor_critic import SoftActorCritic
from components.core.draws import Integers, Normal, UniformDouble
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.data.sizes import DataSizes
from components.models.mlp_ensemble.ensemble import MLPEnsemble, MLPTransition
from components.models.transition.interface import Prediction
from components.models.transition.model_environment import (
    ModelEnvironment,
    PredictionRange,
    RolloutStep,
)

__all__ = ["ALGORITHM", "Config", "Learner"]

CHUNK = 500  # trajectories rolled out at once; part of the random streams' identity
PERCENTILES = (50, 90, 99)  # of the uncertainty, for choosing the penalty


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 100_000
    rollout_every: int = 1000  # updates
    rollouts: int = 50_000  # virtual trajectories a lane each time
    rollout_length: int = 5  # T, steps of each
    retained_rollouts: int = 5  # times, the older ones are overwritten
    penalty: float = 1.0  # lambda, of one standardised target's deviation, in units of reward
    prediction_range: PredictionRange = "free"  # data: clip predictions to the range of the log
    real_ratio: float = 0.05  # share of logged transitions in a batch
    batch: int = 256  # transitions per update
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critics
    learning_rate: float = 3e-4  # Adam, actor, critics and temperature
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "hidden", "rollout_every")
        check_at_least_one(self, "rollouts", "rollout_length", "retained_rollouts")
        if self.penalty < 0 or self.prediction_range not in ("data", "free"):
            raise ValueError("penalty must not be negative and prediction_range be data or free.")
        if self.real_ratio < 0 or self.logged >= self.batch:
            raise ValueError(
                f"real_ratio must lie in [0, 1) and leave virtual transitions in a batch of "
                f"{self.batch}, got {self.real_ratio}."
            )
        check_bootstrapping(self.discount, self.target_rate)
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive.")

    @property
    def logged(self) -> int:
        """Logged transitions in a batch."""
        return round(self.real_ratio * self.batch)


class Learner(SoftActorCritic):
    """A stack of MOPO learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config = config
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        super().__init__(
            data,
            keys,
            hidden=config.hidden,
            learning_rate=config.learning_rate,
            discount=config.discount,
            target_rate=config.target_rate,
        )
        ensembles = inputs.fitted("gaussian_ensemble", MLPEnsemble)
        self._model = MLPTransition(ensembles, data.frame_scaling, device)
        self._environment = ModelEnvironment(
            self._model, inputs.dynamics, data.frame_scaling, device, config.prediction_range
        )
        self._healthy = healthy_ranges(data)
        capacity = config.retained_rollouts * config.rollouts
        self._buffer = ModelBuffer(data, capacity, config.rollout_length)
        self._networks = {**self._networks, "buffer": self._buffer}
        batch, acted, virtual = config.batch, data.action_width, config.batch - config.logged
        self._streams = LaneStreams(
            keys,
            {
                "row": data.row_draw(config.logged),
                # In double precision: single has too few digits for a million places.
                "virtual": UniformDouble(virtual),
                "next": Normal(batch, 1, acted),
                "actor": Normal(batch, 1, acted),
            },
            device,
        )
        self._chunk = min(CHUNK, config.rollouts)
        self._chunks = -(-config.rollouts // self._chunk)
        several, elites = (self._chunk, config.rollout_length), self._model.elites.shape[1]
        self._rollout_streams = LaneStreams(
            keys,
            {
                "start": data.row_draw(self._chunk),
                "elite": Integers([elites] * self.lanes, *several),
                "frame": Normal(*several, self._model.low.shape[1]),
                "action": Normal(*several, acted),
            },
            device,
            block=1,
        )

    # -- virtual trajectories -----------------------------------------------------------------

    def _unroll(self, drawn: Mapping[str, Tensor]) -> Iterator[RolloutStep]:
        """The current policies' steps, from recorded states on."""
        noise = iter(drawn["action"].unbind(dim=2))

        def act(observations: Tensor) -> Tensor:
            parameters = self._actor(observations)
            return self._actor.sample(parameters, next(noise)[:, :, None])[0].squeeze(2)

        elites = self._model.elites
        lane = torch.arange(self.lanes, device=elites.device)[:, None, None]
        return self._environment.unroll(
            *self._data.start_states(drawn["start"], self._model.memory),
            act,
            self._config.rollout_length,
            propagation=elites[lane, drawn["elite"]].permute(2, 0, 1),
            noise=drawn["frame"].permute(2, 0, 3, 1),
        )

    @torch.no_grad()
    def _roll_out(self, number: int) -> dict[str, Tensor]:
        """Write roll-out ``number``, from 0, over the oldest one kept; metrics of it.

        Metrics show the penalty before lambda and the reward before the penalty, of all steps: also
        of those after a fall, which are never drawn.

        Trajectories are made in chunks, which bounds the memory. All counters follow from the step
        number, so the ring alone is part of the state.
        """
        config = self._config
        place = number % config.retained_rollouts * config.rollouts
        seen: list[Tensor] = []
        for n in range(self._chunks):
            wanted = min(self._chunk, config.rollouts - n * self._chunk)
            drawn = self._rollout_streams.at(number * self._chunks + n)
            drawn = {name: numbers[:, :wanted] for name, numbers in drawn.items()}
            steps = list(self._unroll(drawn))
            uncertainties = [uncertainty(step.prediction) for step in steps]
            frames = [step.frames for step in steps]
            self._buffer.write(
                place + n * self._chunk,
                drawn["start"],
                frames,
                [step.actions for step in steps],
                [s.rewards - config.penalty * u for s, u in zip(steps, uncertainties, strict=True)],
                None if self._healthy is None else steps_before_fall(frames, self._healthy),
            )
            seen += [
                torch.stack([u, step.rewards, self._outside(step)], dim=1)
                for step, u in zip(steps, uncertainties, strict=True)
            ]
        penalty, reward, outside = torch.cat(seen, dim=2).unbind(dim=1)
        return {
            "model/penalty": penalty.mean(dim=1),
            "model/virtual_reward": reward.mean(dim=1),
            "model/outside_share": outside.mean(dim=1),
        } | {f"model/penalty_{percent}": percentile(penalty, percent) for percent in PERCENTILES}

    def _outside(self, step: RolloutStep) -> Tensor:
        """1 where a frame was drawn outside the range of the training data, else 0: ``[L, B]``."""
        low, high = (t[:, :, None, None] for t in (self._model.low, self._model.high))
        beyond = (step.drawn < low) | (step.drawn > high)
        return beyond.any(dim=1).squeeze(1).float()

    # -- update -----------------------------------------------------------------------------

    def _batch(self, drawn: Mapping[str, Tensor], step: int) -> Batch:
        """Logged transitions first, then virtual ones."""
        config = self._config
        filled = self._buffer.count(self._kept(step) * config.rollouts)
        virtual = self._buffer.batch((drawn["virtual"] * filled).long())
        if config.logged == 0:
            return virtual
        logged = self._data.batch(drawn["row"])
        return Batch(
            **{
                f.name: torch.cat([getattr(logged, f.name), getattr(virtual, f.name)], dim=1)
                for f in fields(Batch)
            }
        )

    def _kept(self, step: int) -> int:
        """Roll-outs in the buffer."""
        return min(step // self._config.rollout_every + 1, self._config.retained_rollouts)

    def branch(self, step: int) -> int | None:
        """Number of roll-outs in the buffer; None for a step that begins with a roll-out.

        A graph would have to hold each of the places that roll-outs are written to. One of 1,000
        updates goes without: some 25,000 launches, an estimated tenth of a second beside 1,000
        updates of a millisecond or more.
        """
        return self._kept(step) if step % self._config.rollout_every else None

    def update(self, step: int) -> dict[str, Tensor]:
        """One update on all lanes, after a new roll-out where one is due."""
        metrics = {}
        if step % self._config.rollout_every == 0:
            metrics = self._roll_out(step // self._config.rollout_every)
        drawn = self._streams.at(step)
        return metrics | self.improve(self._batch(drawn, step), drawn["next"], drawn["actor"])


def uncertainty(prediction: Prediction) -> Tensor:
    """Largest norm of predicted deviations among all members, in standardised units: ``[L, B]``.

    Raises:
        ValueError: If the members are deterministic.
    """
    if prediction.spread is None:
        raise ValueError("The penalty needs Gaussian members; deterministic ones have no spread.")
    norms: Tensor = torch.linalg.vector_norm(prediction.spread, dim=1)
    return norms.amax(dim=1)


def percentile(values: Tensor, percent: int) -> Tensor:
    """Percentile ``[L]`` of ``values [L, N]``, without interpolation: one of the values."""
    rank = -(-percent * values.shape[1] // 100)
    return values.kthvalue(rank, dim=1).values


def _cost(config: Config, sizes: DataSizes) -> float:
    rounds = -(-config.updates // config.rollout_every)
    virtual = 3.5e-5 * float(rounds * config.rollouts * config.rollout_length)
    return per_transition(5.6e-5)(config, sizes) + virtual


ALGORITHM: Final = Algorithm(
    name="mopo",
    config=Config,
    learner=Learner,
    version=2,
    version_with_falls=3,
    cost=_cost,
    needs=("gaussian_ensemble",),
    frame_epsilon=1e-3,
)
