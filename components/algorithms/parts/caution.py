"""Caution: a price on leaving the log's support along virtual trajectories.

Models are wrong where nothing was logged, and a policy that is trained in them finds these places:
it is promised what it does not get. No member of an ensemble warns of that, since all of them have
seen the same log (docs/caution.md). What warns is the log itself. Of a step of a virtual
trajectory, ``d`` is the distance of frame and action to the nearest logged ones, in units of the
log's own deviations, and

    e = max(0, 1 - limit / d)                                  (0 within the support, below 1)
    price = caution * sum_t gamma^t e_t / sum_t gamma^t        (over every fifth step)

in units of the log's mean return is taken off a trajectory's return. The limit is the quantile of
the same distance over what is familiar: held-out logged transitions, and what the behaviour policy
visits in the models. Both ``d`` and ``e`` are differentiable in frame and action; the choice of the
neighbour is not, and need not be. Beyond the limit the slope never vanishes, so that a policy that
has left finds back.

``disagreement`` is the candidate that was compared: ``d`` is then the members' standard deviation
at a step, the mean over learned features.
"""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.splits import split_episodes
from components.models.transition.model_environment import RolloutStep

__all__ = ["MEASURES", "Caution", "check_caution"]

MEASURES: Final = ("distance", "disagreement")
"""What is measured of a step."""

_NEIGHBOURS: Final = 2000  # logged transitions that steps are compared with
_QUANTILE: Final = 0.99  # of what is familiar that lies within
_EVERY: Final = 5  # steps: neighbouring ones hardly differ


def check_caution(caution: float | None, measure: str) -> None:
    """Refuse settings outside their range.

    Raises:
        ValueError: Naming the setting.
    """
    if caution is not None and caution < 0:
        raise ValueError(f"caution must not be negative, got {caution}; null leaves it out.")
    if measure not in MEASURES:
        raise ValueError(f"caution_by must be one of {', '.join(MEASURES)}, got {measure!r}.")


class Caution:
    """The support of L logs.

    Args:
        data: The lanes' logs.
        scaling: In which policies see frames, ``[L, F]``.
        measure: One of `MEASURES`.

    Attributes:
        limit: ``[L, 1]`` where the support ends.
    """

    def __init__(self, data: LaneData, scaling: Normaliser, measure: str = MEASURES[0]) -> None:
        self._measure, self._width = measure, data.frame_width
        sides = [_logged(dataset) for dataset in data.datasets]
        size = min(len(side[0]) for side in sides)
        near = torch.stack([near[_spread(len(near), size)] for near, _ in sides]).to(data.device)
        scaling = scaling.to(data.device)
        self._near = self._scaled(near, scaling)
        deviation = self._near.std(dim=1, keepdim=True)
        # A feature that never changes says nothing, but another value of it is foreign.
        self._unit = torch.where(deviation > 0, deviation, 1.0)
        self._near = self._near / self._unit
        self._squares = self._near.square().sum(dim=2)[:, None]
        self.limit = torch.zeros(data.lanes, 1, device=data.device)
        if measure == "distance":
            size = min(len(side[1]) for side in sides)
            own = torch.stack([own[_spread(len(own), size)] for _, own in sides]).to(data.device)
            self._widen(self._distance(self._scaled(own, scaling)))

    def _scaled(self, pairs: Tensor, scaling: Normaliser) -> Tensor:
        frames, actions = pairs.split([self._width, pairs.shape[2] - self._width], dim=2)
        mean, scale = scaling.mean[:, None], scaling.scale[:, None]
        return torch.cat([(frames - mean) / scale, actions], dim=2)

    def _widen(self, familiar: Tensor) -> None:
        found = torch.quantile(familiar, _QUANTILE, dim=1, keepdim=True)
        self.limit = torch.maximum(self.limit, found)

    @torch.no_grad()
    def familiar(self, steps: Sequence[RolloutStep]) -> None:
        """Take what the behaviour policy visits as familiar: the limit becomes no less for it."""
        self._widen(torch.cat([self._of(step) for step in steps[::_EVERY]], dim=1))

    def excess(self, steps: Sequence[RolloutStep], discount: float) -> Tensor:
        """How far trajectories are outside, ``[L, N]`` from 0, never, to below 1, always."""
        chosen = steps[::_EVERY]
        weights = torch.tensor([discount ** (_EVERY * n) for n in range(len(chosen))])
        weights = (weights / weights.sum()).to(self.limit.device)
        outside = torch.stack([self._outside(self._of(step)) for step in chosen], dim=-1)
        return (outside * weights).sum(dim=-1)

    def _outside(self, measured: Tensor) -> Tensor:
        # Where nothing is familiar but the log itself the limit may be 0.
        limit = self.limit.clamp(min=1e-6)
        return 1.0 - limit / torch.maximum(measured, limit)

    def _of(self, step: RolloutStep) -> Tensor:
        """The measure of a step, ``[L, N]``."""
        if self._measure == "disagreement":
            return step.prediction.values.std(dim=2).mean(dim=1)
        newest = step.observations[..., : self._width]
        return self._distance(torch.cat([newest, step.actions], dim=-1))

    def _distance(self, pairs: Tensor) -> Tensor:
        """Distance ``[L, N]`` of ``pairs [L, N, F + A]`` to the nearest logged ones."""
        pairs = pairs / self._unit
        with torch.no_grad():
            # The pair's own square is the same for all neighbours.
            apart = torch.baddbmm(self._squares, pairs, self._near.transpose(1, 2), alpha=-2.0)
            nearest = apart.min(dim=2).indices
        found = self._near.gather(1, nearest[..., None].expand_as(pairs))
        # The root of 0 has no derivative.
        return (pairs - found).square().sum(dim=2).clamp(min=1e-12).sqrt()


def _logged(dataset: OfflineDataset) -> tuple[Tensor, Tensor]:
    """Raw frames with actions ``[n, F + A]``: those to compare with, and held-out ones."""
    boundary = split_episodes(dataset).trained_transitions(dataset)
    rows = torch.from_numpy(dataset.frame_rows())
    whole = [torch.arange(boundary), torch.arange(boundary, dataset.transitions)]
    pairs = []
    for part in whole:
        part = part[_spread(len(part), _NEIGHBOURS)]
        frames = torch.from_numpy(dataset.frames[rows[part].numpy()])
        actions = torch.from_numpy(dataset.actions[part.numpy()])
        pairs.append(torch.cat([frames, actions], dim=1).float())
    return pairs[0], pairs[1]


def _spread(size: int, count: int) -> Tensor:
    """At most ``count`` of ``size`` places, evenly spaced."""
    return torch.linspace(0, size - 1, min(size, count)).round().long()
