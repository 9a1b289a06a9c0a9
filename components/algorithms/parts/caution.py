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

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.batches import LaneData
from components.data.pairs import split_pairs
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
        sides = [split_pairs(dataset, _NEIGHBOURS, _spread) for dataset in data.datasets]
        near, counts = _stacked([near for near, _ in sides])
        scaling = scaling.to(data.device)
        self._near = self._scaled(near.to(data.device), scaling)
        own = zip(self._near, counts, strict=True)
        deviation = torch.stack([lane[:count].std(dim=0, keepdim=True) for lane, count in own])
        # A feature that never changes says nothing, but another value of it is foreign.
        self._unit = torch.where(deviation > 0, deviation, 1.0)
        self._near = self._near / self._unit
        self._squares = self._near.square().sum(dim=2)[:, None]
        self.limit = torch.zeros(data.lanes, 1, device=data.device)
        if measure == "distance":
            held_out, counts = _stacked([held_out for _, held_out in sides])
            apart = self._distance(self._scaled(held_out.to(data.device), scaling))
            self._widen([lane[:count] for lane, count in zip(apart, counts, strict=True)])

    def _scaled(self, pairs: Tensor, scaling: Normaliser) -> Tensor:
        frames, actions = pairs.split([self._width, pairs.shape[2] - self._width], dim=2)
        mean, scale = scaling.mean[:, None], scaling.scale[:, None]
        return torch.cat([(frames - mean) / scale, actions], dim=2)

    def _widen(self, familiar: Iterable[Tensor]) -> None:
        """Let nearly all of every lane's distances lie within."""
        found = torch.stack([lane.quantile(_QUANTILE, dim=0, keepdim=True) for lane in familiar])
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


def _stacked(lanes: Sequence[NDArray[np.floating]]) -> tuple[Tensor, list[int]]:
    """Rows of every lane, ``[L, n, D]``, and how many are its own: the shorter ones are repeated.

    A repeated neighbour changes no distance. What depends on their number, deviations and
    quantiles, is taken of a lane's own, so that no lane feels how long the others' logs are.
    """
    counts = [len(lane) for lane in lanes]
    places = np.arange(max(counts))
    repeated = [lane[places % count] for lane, count in zip(lanes, counts, strict=True)]
    return torch.from_numpy(np.stack(repeated)).float(), counts


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most ``count`` of the rows, evenly spaced.

    Places are rounded from float32, other than in `spread_rows`: a few of the thousands differ by
    one, and trained policies depend on them.
    """
    size = len(rows)
    places = torch.linspace(0, size - 1, min(size, count)).round().long()
    chosen: NDArray[np.int64] = rows[places.numpy()]
    return chosen
