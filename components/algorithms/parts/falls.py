"""Falls in virtual trajectories, by the healthy ranges of frame features on the dataset's card.

A card's dynamics may name, under ``healthy``, frame features with their least and largest value;
null is no limit. A system whose card names none cannot fall.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from components.data.batches import LaneData

__all__ = ["healthy_ranges", "steps_before_fall"]

Ranges = tuple[Tensor, Tensor]
"""Least and largest scaled frames, ``[L, 1, F]`` each."""


def healthy_ranges(data: LaneData) -> Ranges | None:
    """Limits of scaled frames, outside of which a state is a fall; None if no system can fall.

    Raises:
        ValueError: If a card names a feature that its frames lack.
    """
    limits = torch.empty(2, data.lanes, data.frame_width)
    limits[0], limits[1] = -torch.inf, torch.inf
    for lane, dataset in enumerate(data.datasets):
        card = dataset.card
        for name, ends in card.dynamics.get("healthy", {}).items():
            if name not in card.frame_features:
                raise ValueError(
                    f"The card of {card.name} has a healthy range of {name!r}, which is no feature "
                    f"of its frames {card.frame_features}."
                )
            for side, end in enumerate(ends):
                if end is not None:
                    limits[side, lane, card.frame_features.index(name)] = end
    if not limits.isfinite().any():
        return None
    scaling = data.frame_scaling
    low, high = scaling.apply(limits.to(data.device))[:, :, None]
    return low, high


def steps_before_fall(frames: Sequence[Tensor], healthy: Ranges) -> Tensor:
    """First step of trajectories after which they have fallen, or T: ``[L, N]``.

    Args:
        frames: T scaled frames ``[L, N, F]``, each after its step.
        healthy: Limits, outside of which a state is a fall.
    """
    low, high = healthy
    every = torch.stack([*frames])  # [T, L, N, F]
    stands = ((low < every) & (every < high)).all(dim=-1)
    return stands.long().cumprod(dim=0).sum(dim=0)
