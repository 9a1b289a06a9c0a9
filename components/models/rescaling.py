"""Adapt a fitted network to frames in another scaling than that of its training."""

import torch
from torch import Tensor

from components.core.normaliser import Normaliser

__all__ = ["read_in_scaling"]


def read_in_scaling(
    weight: Tensor, bias: Tensor, own: Normaliser, given: Normaliser, history: int
) -> tuple[Tensor, Tensor]:
    """Fold a change of scaling into a first layer.

    An affine map of scaled frames is an affine map of the same frames scaled otherwise, so a model
    reads the observations of a policy at no additional cost.

    Args:
        weight: ``[L * M, in, H]`` of M networks a lane; the first inputs are ``history`` frames.
        bias: ``[L * M, 1, H]``.
        own: Scaling of the frames the layer was trained on, ``[L, F]``.
        given: Scaling of the frames it is to read, ``[L, F]``.
        history: Frames read.

    Returns:
        The layer for frames in the given scaling; further inputs enter as before.
    """
    lanes = len(own.mean)
    factor = (given.scale / own.scale).repeat(1, history)  # [L, history * F]
    offset = ((given.mean - own.mean) / own.scale).repeat(1, history)
    seen, rest = weight.split([factor.shape[1], weight.shape[1] - factor.shape[1]], dim=1)
    by_lane = seen.view(lanes, -1, *seen.shape[1:])
    moved = torch.einsum("li,lmih->lmh", offset, by_lane).flatten(0, 1)[:, None]
    scaled = (factor[:, None, :, None] * by_lane).flatten(0, 1)
    return torch.cat([scaled, rest], dim=1), bias + moved
