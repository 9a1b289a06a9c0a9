"""How random a log's actions are: EAS, the expected action stochasticity of thesis chapter 4.

A squashed Gaussian ``a = tanh(u)``, ``u ~ N(mean(s), std(s)^2)`` with one trunk for both is fitted
to the logged actions by their likelihood (thesis 4.3, 4.4). EAS is the mean of the standard
deviations over all states of the log and all values of an action (4.5, 4.6). It is the spread
before the tanh, so it may exceed 1.

Logged actions often lie on a bound, where the inverse of tanh is infinite. They are clipped before
it, the thesis does not say how strongly, and the clip decides the order of the logs: measured with
the published ranks of the sixteen sets, a clip close to 1 makes the spread that of the rare actions
at the bound. 0.9 fits the published order best and is taken. What other clips would have said is
fitted beside it, one lane per clip, so that nobody has to take the number on trust.

This differs from :mod:`components.models.gaussian_behaviour`, a clone that is deployed, in what is
cheap: a small budget in updates, whatever the log's size; all clips as lanes of one program that
read the same batches from equal first weights; and any log, even of a single episode.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from components.core.draws import Integers
from components.core.random_streams import LaneStreams
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models.supervised import UNWATCHED, Monitor, StackedFit, ended_at
from components.networks.gaussian import TanhGaussian, log_density

__all__ = [
    "LOG_SPREAD_RANGE",
    "ActionStochasticity",
    "StochasticityConfig",
    "fit_action_stochasticity",
]

LOG_SPREAD_RANGE = (-3.0, 2.0)
"""Bounds of the log deviation. A spread of 0.05 means no exploration as much as one of 0.005 does,
and with a lower bound the likelihood of deterministic logs is steep enough to upset the fit."""
_HELD_OUT = 0.1  # last share of the episodes, or of the transitions of a single one
_VALIDATED = 2048  # held-out transitions that are looked at, evenly spaced
_BEGUN_WITH = 16384  # training transitions whose moments are the fit's first guess
_VALIDATIONS = 10  # per fit
_CHUNK = 4096  # transitions at once, which limits the memory


@dataclass(frozen=True, kw_only=True)
class StochasticityConfig:
    """How the spread is fitted."""

    clip: float = 0.9  # logged actions are clipped to +- this before the inverse tanh
    clips: tuple[float, ...] = (0.7, 0.8, 0.9, 0.95, 0.97, 0.99, 0.999)  # shown beside it
    hidden: tuple[int, ...] = (64, 64)  # layer widths of the trunk
    updates: int = 600  # whatever the size of the log
    batch: int = 256  # transitions per update
    learning_rate: float = 2e-3  # Adam, at the start; falls to zero along half a cosine

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        if min(self.updates, self.batch, *self.hidden) < 1:
            raise ValueError("updates, batch and every hidden width must be at least 1.")
        if not all(0 < clip < 1 for clip in (self.clip, *self.clips)):
            raise ValueError("clip and clips must lie in (0, 1).")
        if self.learning_rate <= 0:
            raise ValueError("learning_rate must be positive.")

    @property
    def lanes(self) -> tuple[float, ...]:
        """All clips in rising order, each once; one lane each."""
        return tuple(sorted({self.clip, *self.clips}))


@dataclass(frozen=True)
class ActionStochasticity:
    """The fitted spread of a log.

    Attributes:
        clip: The clip of EAS.
        clips: All clips in rising order.
        spread: Per clip and value of an action, the mean standard deviation before the tanh.
        held_out: Per clip, the held-out negative log density of clipped actions. Those of
            different clips are not comparable.
    """

    clip: float
    clips: tuple[float, ...]
    spread: tuple[tuple[float, ...], ...]
    held_out: tuple[float, ...]

    @property
    def expected(self) -> dict[float, float]:
        """EAS by clip."""
        return {c: float(np.mean(s)) for c, s in zip(self.clips, self.spread, strict=True)}

    @property
    def eas(self) -> float:
        """EAS (thesis 4.6)."""
        return self.expected[self.clip]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> "ActionStochasticity":
        """From the fields as JSON has them."""
        spread = tuple(tuple(row) for row in record["spread"])
        return cls(record["clip"], tuple(record["clips"]), spread, tuple(record["held_out"]))


def fit_action_stochasticity(
    dataset: OfflineDataset,
    config: StochasticityConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> ActionStochasticity:
    """Fit the spread of a log's actions for every clip.

    Of every lane its state of highest held-out likelihood is measured, on all states of the log:
    small logs would otherwise be learned by heart and seem deterministic.

    Args:
        dataset: The log, of at least two transitions.
        config: Clips and budget.
        key: Random stream, see :func:`components.core.random_streams.lane_key`.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out losses.

    Raises:
        DivergedError: A lane never had a finite state of finite held-out loss.
        ValueError: The log has a single transition.
    """
    if dataset.transitions < 2:
        raise ValueError(f"{dataset.card.name} has a single transition, which has no spread.")
    trained = _trained_transitions(dataset)
    data = LaneData([dataset], device)
    lanes = len(config.lanes)
    clips = torch.tensor(config.lanes, device=device)[:, None, None]
    sizes = (data.observation_width, *config.hidden, data.action_width)
    network = TanhGaussian([key] * lanes, "weights", sizes, LOG_SPREAD_RANGE, squash=True)
    network.to(device)

    def raw_actions(index: Tensor) -> Tensor:
        """Clipped actions ``[L, B, A]`` of transitions ``[1, B]``, before the tanh."""
        return torch.atanh(torch.clamp(data.actions(index), -clips, clips))

    def cost(network: TanhGaussian, index: Tensor) -> Tensor:
        """Negative log densities ``[L, B]`` of the clipped actions of transitions ``[1, B]``."""
        seen = data.observations(index).expand(lanes, -1, -1)
        mean, log_std = network(seen)
        return -log_density(mean, log_std, raw_actions(index))

    def loss(
        network: TanhGaussian, drawn: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        return cost(network, drawn["row"]).mean(dim=1), {}

    held_out = _spaced(trained, dataset.transitions, _VALIDATED).to(device)
    _begin_at(network, raw_actions(_spaced(0, trained, _BEGUN_WITH).to(device)))
    rows = {"row": Integers([trained], config.batch)}
    fitting = StackedFit(
        network,
        lanes,
        loss,
        LaneStreams([key], rows, device),
        learning_rate=config.learning_rate,
        schedule="cosine",
    )
    curves = fitting.run(
        lambda network: cost(network, held_out).mean(dim=1),
        [f"{dataset.card.name}/{clip}" for clip in config.lanes],
        updates=config.updates,
        validate_every=max(1, config.updates // _VALIDATIONS),
        checkpoint=checkpoint,
        monitor=monitor,
    )
    ended_at(curves, fitting.best_loss)
    spread = _mean_spread(fitting.best, data, lanes)
    return ActionStochasticity(
        clip=config.clip,
        clips=config.lanes,
        spread=tuple(tuple(row) for row in spread.tolist()),
        held_out=tuple(fitting.best_loss.tolist()),
    )


def _spaced(first: int, end: int, most: int) -> Tensor:
    """At most so many transitions from ``first`` to before ``end``, evenly spaced, ``[1, B]``."""
    rows = np.linspace(first, end - 1, most).round().astype(np.int64)
    return torch.from_numpy(np.unique(rows))[None]


@torch.no_grad()
def _begin_at(network: TanhGaussian, raw: Tensor) -> None:
    """Make networks predict the best Gaussian that does not depend on the state.

    A fit that begins elsewhere widens its spread first, as far as its mean is from the actions.

    Args:
        network: L lanes.
        raw: ``[L, B, A]`` clipped actions before the tanh.
    """
    weight, bias = network.stack.affine()[-1]
    log_std = raw.std(dim=1, correction=0).log().clamp(network.low + 0.1, network.high - 0.1)
    share = (log_std - network.low) / (network.high - network.low)
    weight.zero_()
    bias.copy_(torch.cat([raw.mean(dim=1), torch.atanh(2.0 * share - 1.0)], dim=1)[:, None])


def _trained_transitions(dataset: OfflineDataset) -> int:
    """How many of the first transitions are trained on."""
    if dataset.episodes > 1:
        held = min(max(1, round(_HELD_OUT * dataset.episodes)), dataset.episodes - 1)
        return int(dataset.episode_starts[dataset.episodes - held])
    return max(1, int((1.0 - _HELD_OUT) * dataset.transitions))


@torch.no_grad()
def _mean_spread(network: TanhGaussian, data: LaneData, lanes: int) -> Tensor:
    """Mean standard deviations over all transitions, ``[L, A]``."""
    total = torch.zeros(lanes, data.action_width, dtype=torch.float64, device=data.device)
    bounds = [*range(0, data.counts[0], _CHUNK), data.counts[0]]
    for first, end in pairwise(bounds):
        index = torch.arange(first, end, device=data.device)[None]
        _, log_std = network(data.observations(index).expand(lanes, -1, -1))
        total += log_std.exp().sum(dim=1, dtype=torch.float64)
    return total / data.counts[0]
