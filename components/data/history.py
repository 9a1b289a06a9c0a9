"""Observation histories as a gather over frames stored once.

An observation is the last L frames, newest first; before the episode had L frames, its first frame
stands for the missing ones. Rows of frames are found by arithmetic, so a batch of histories is one
gather, on whatever device the frames live. Pure functions; each takes NumPy arrays or torch
tensors and returns the same kind.
"""

from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

__all__ = ["gather_history", "history_rows"]

Rows = TypeVar("Rows", NDArray[np.int64], torch.Tensor)
Values = TypeVar("Values", NDArray[np.float32], torch.Tensor)


def history_rows(newest: Rows, first: Rows, length: int) -> Rows:
    """Frame rows of histories.

    Args:
        newest: `[...]` row of each history's newest frame.
        first: `[...]` row of the first frame of its episode.
        length: L, frames in a history.

    Returns:
        `[..., L]` rows, newest first, never before the episode's first frame.
    """
    if isinstance(newest, torch.Tensor) and isinstance(first, torch.Tensor):
        lags = torch.arange(length, device=newest.device)
        return torch.maximum(newest[..., None] - lags, first[..., None])
    lags_back = np.asarray(newest)[..., None] - np.arange(length)
    rows: NDArray[np.int64] = np.maximum(lags_back, np.asarray(first)[..., None])
    return rows


def gather_history(frames: Values, newest: Rows, first: Rows, length: int) -> Values:
    """Histories flattened frame by frame, newest first.

    Args:
        frames: `[rows, F]`.
        newest: `[...]` rows, on the device of the frames.
        first: `[...]` rows.
        length: L.

    Returns:
        `[..., L * F]`; values k F ... k F + F - 1 are the frame of lag k.
    """
    gathered: Values = frames[history_rows(newest, first, length)]
    stacked: Values = gathered.reshape(*gathered.shape[:-2], length * frames.shape[-1])
    return stacked
