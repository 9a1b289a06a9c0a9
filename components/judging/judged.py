"""The policies to be judged: snapshots times proximities, acting side by side."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from components.core.random_streams import lane_generator, lane_key
from components.policies.policy import Policy

__all__ = ["JudgedPolicies"]

_AT_ONCE = 50_000
"""Observations that act together: more need much memory and are no faster."""


@dataclass(frozen=True)
class JudgedPolicies:
    """Q = S x G policies: every one of S snapshots at every one of G proximities.

    Attributes:
        policy: The snapshots, as lanes.
        proximities: The grid; a single NaN for policies that take none.
    """

    policy: Policy
    proximities: tuple[float, ...]

    @classmethod
    def of(cls, policy: Policy, grid: Sequence[float]) -> "JudgedPolicies":
        """Snapshots at a grid of proximities, if they take one."""
        takes = policy.card.takes_proximity
        return cls(policy, tuple(grid) if takes else (float("nan"),))

    @property
    def count(self) -> int:
        """Number of policies Q."""
        return self.policy.lanes * len(self.proximities)

    def act(self, histories: Tensor, key: int) -> Tensor:
        """Actions of all policies, each at its own observations.

        Args:
            histories: ``[Q, B, H, F]`` raw frames, newest first; snapshots first, then proximities.
            key: Stream of the noise from which candidates are made, equal for all policies.

        Returns:
            ``[Q, B, A]``.
        """
        snapshots, grid = self.policy.lanes, len(self.proximities)
        batch = histories.shape[1]
        step = max(1, _AT_ONCE // (snapshots * grid))
        generator = lane_generator(lane_key(key, "candidates"))
        parts = []
        for first in range(0, batch, step):
            part = histories[:, first : first + step]
            size = part.shape[1]
            seen = part.reshape(snapshots, grid * size, *part.shape[2:])
            proximity = noise = None
            if self.policy.card.takes_proximity:
                values = torch.tensor(self.proximities, device=part.device)
                proximity = values.repeat_interleave(size).expand(snapshots, -1)
            if self.policy.card.candidates:
                shape = size, self.policy.card.candidates, self.policy.card.noise
                fresh = torch.from_numpy(generator.standard_normal(shape, "float32"))
                noise = fresh.to(part.device).expand(snapshots, *shape)
            acted = self.policy.act(seen, proximity, noise)
            parts.append(acted.reshape(snapshots * grid, size, -1))
        return torch.cat(parts, dim=1)

    def act_at(self, histories: Tensor, key: int) -> Tensor:
        """Actions ``[Q, B, A]`` of all policies at the same observations ``[B, H, F]``."""
        return self.act(histories.expand(self.count, *histories.shape), key)
