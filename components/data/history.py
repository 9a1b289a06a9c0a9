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

__all__ = ["gather_history", "history_rows", "newest_first"]

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


def newest_first(
    episode_starts: NDArray[np.int64], length: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """An order of frames in which every history of ``length`` frames is one run of rows.

    Every episode is laid out from its last frame to its first, which is repeated: a history then
    reads on into the repetitions where the episode had fewer frames.

    Args:
        episode_starts: `[E + 1]` first transition of each episode, and their number N.
        length: L, the longest history wanted.

    Returns:
        `[N + E + E (L - 1)]` which frame stands in each row, and `[N + E]` the row of each frame.
    """
    episodes = np.arange(len(episode_starts) - 1)
    first, last = episode_starts[:-1] + episodes, episode_starts[1:] + episodes
    order = np.concatenate(
        [
            np.concatenate([np.arange(newest, oldest - 1, -1), np.full(length - 1, oldest)])
            for oldest, newest in zip(first, last, strict=True)
        ]
    )
    place = np.empty(last[-1] + 1, dtype=np.int64)
    # Written backwards, so that a repeated frame keeps the row of its first appearance.
    place[order[::-1]] = np.arange(len(order))[::-1]
    return order, place
