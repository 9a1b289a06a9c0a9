"""Values of policies in an ensemble, and what they would visit there.

Every member continues its own copy of each trajectory, so that members disagree about a policy by
the values they give it. The same start states serve all policies and all members.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.data.pairs import spread_rows
from components.data.starts import start_rows
from components.judging.config import JudgeConfig
from components.judging.judged import JudgedPolicies
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.transition.model_environment import ModelEnvironment, discounted_sum

__all__ = ["NEARLY", "VirtualValues", "VirtualWorld"]

NEARLY: Final = (0.01, 0.99)
"""Quantiles between which nearly all frames of virtual trajectories lie."""
_ROUNDING: Final = 1e-5  # of a range, by which what is held at its end may miss it


@dataclass(frozen=True)
class VirtualValues:
    """What Q policies are worth in an ensemble of K members.

    Attributes:
        returns: ``[Q, K, B]`` discounted returns from B start states.
        visited: ``[Q, V, F + A]`` some frames on the way, each with the action taken there.
        ends: ``[2, F]`` between which the ensemble's predictions are held.
    """

    returns: Tensor
    visited: Tensor
    ends: Tensor

    @property
    def mean(self) -> Tensor:
        """``[Q]``."""
        return self.returns.mean(dim=(1, 2))

    @property
    def error(self) -> Tensor:
        """Standard error of the mean by members and start states, taken as independent, ``[Q]``."""
        of_members = _variance(self.returns.mean(dim=2)) / self.returns.shape[1]
        of_starts = _variance(self.returns.mean(dim=1)) / self.returns.shape[2]
        return (of_members + of_starts).sqrt()

    @property
    def least(self) -> Tensor:
        """Value by the member that gives the least, ``[Q]``."""
        return self.returns.mean(dim=2).amin(dim=1)

    @property
    def frames(self) -> Tensor:
        """Between which values nearly all frames on the way lie, ``[Q, 2, F]``: :data:`NEARLY`."""
        ends = torch.tensor(NEARLY, dtype=torch.float64)
        return torch.quantile(self._seen.double(), ends, dim=1).transpose(0, 1)

    @property
    def held(self) -> Tensor:
        """Share of the frames on the way that are held at either end, ``[Q, 2, F]``.

        There the ensemble would go on and may not: what it expects is not what a system would do.
        """
        low, high = self.ends
        width = high - low
        rounding = torch.where(width.isfinite(), _ROUNDING * width, 0.0)
        at = [self._seen <= low + rounding, self._seen >= high - rounding]
        return torch.stack([held.double().mean(dim=1) for held in at], dim=1)

    @property
    def _seen(self) -> Tensor:
        """The frames on the way, ``[Q, V, F]``."""
        return self.visited[..., : self.ends.shape[1]]


class VirtualWorld:
    """The states of a log from which policies are unrolled, whatever the ensemble.

    Args:
        dataset: The log.
        config: Number and place of the start states.
        device: Where to compute.

    Attributes:
        starts: Transitions in whose states trajectories start, ``[B]``.
    """

    def __init__(self, dataset: OfflineDataset, config: JudgeConfig, device: torch.device) -> None:
        self._dataset, self._config, self.device = dataset, config, device
        width = dataset.frames.shape[1]
        # Policies have scalings of their own: they are shown frames as they were logged.
        self._raw = Normaliser(torch.zeros(width), torch.ones(width))
        self._data = LaneData([dataset], device, scaling=lambda _: self._raw)
        rows = start_rows(dataset, config.start_window)
        self.starts = torch.from_numpy(spread_rows(rows, config.starts)).to(device)

    @property
    def start_histories(self) -> Tensor:
        """Raw histories ``[B, H, F]`` of the start states."""
        return self.histories(self.starts)

    def histories(self, rows: Tensor) -> Tensor:
        """Raw histories ``[B, H, F]`` of transitions ``[B]``."""
        return self._data.raw_histories(rows[None])[0]

    def next_histories(self, rows: Tensor) -> Tensor:
        """Raw histories ``[B, H, F]`` of the states after transitions ``[B]``."""
        shape = len(rows), self._dataset.card.history, self._data.frame_width
        return self._data.batch(rows[None]).next_observations[0].reshape(shape)

    @torch.no_grad()
    def values(self, ensemble: RecurrentEnsemble, judged: JudgedPolicies) -> VirtualValues:
        """Unroll all policies over the return's horizon in every member of an ensemble."""
        card, count = self._dataset.card, judged.count
        environment = ModelEnvironment(
            RecurrentTransition([ensemble], self.device),
            DynamicsSpecification.of_card(card),
            Normaliser.stack([self._raw]).to(self.device),
            self.device,
        )
        members, starts = ensemble.members, len(self.starts)
        begun = self._data.start_states(self.starts[None], environment.model.memory)
        observations, past = (
            part[:, None].expand(1, count, *part.shape[1:]).flatten(1, 2) for part in begun
        )
        key, histories = lane_key(card.name, "judge"), (card.history, self._data.frame_width)
        step = 0

        def act(seen: Tensor) -> Tensor:
            # Members first, then policies: [1, K * Q * B, O]
            apart = seen.view(members, count, starts, *histories).transpose(0, 1)
            own = apart.reshape(count, members * starts, *histories)
            actions = judged.act(own, lane_key(key, step))
            by_member = actions.view(count, members, starts, -1).transpose(0, 1)
            return by_member.reshape(1, members * count * starts, -1)

        rewards, visited = [], []
        looked_at = self._looked_at(members)
        for done, unrolled in enumerate(
            environment.unroll(observations, past, act, card.return_steps, "isolated")
        ):
            step = done + 1
            rewards.append(unrolled.rewards[0])
            chosen = looked_at.get(done)
            if chosen is not None:
                newest = unrolled.observations[0, :, : histories[1]]
                pairs = torch.cat([newest, unrolled.actions[0]], dim=-1)
                by_policy = pairs.view(members, count, starts, -1).transpose(0, 1).flatten(1, 2)
                visited.append(by_policy[:, chosen])
        total = discounted_sum(rewards, card.discount)
        returns = total.view(members, count, starts).transpose(0, 1)
        ends = environment.frame_range[:, 0]
        return VirtualValues(returns.cpu(), torch.cat(visited, dim=1).cpu(), ends.cpu())

    def _looked_at(self, members: int) -> dict[int, Tensor]:
        """Trajectories among K * B by step: V places spread over all steps and trajectories."""
        steps, trajectories = self._dataset.card.return_steps, members * len(self.starts)
        places = spread_rows(np.arange(steps * trajectories), self._config.visited)
        step = places // trajectories
        return {int(t): torch.from_numpy(places[step == t] % trajectories) for t in np.unique(step)}


def _variance(values: Tensor) -> Tensor:
    """Of ``[Q, n]`` over the second axis; 0 where there is a single value."""
    if values.shape[1] < 2:
        return torch.zeros(len(values))
    return values.var(dim=1)
