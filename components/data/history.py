"""Observation histories from frames stored once.

An observation is the last L frames, newest first; while the episode has fewer, its first frame is
repeated. Row numbers are computed, so a batch of histories is one gather. Where many batches are
drawn, frames are laid out so that every history is a run of consecutive rows.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["gather_history", "history_rows", "newest_first"]

Rows = NDArray[np.int64]


def history_rows(newest: Rows, first: Rows, length: int) -> Rows:
    """Frame rows of histories.

    Args:
        newest: `[...]` row of each history's newest frame.
        first: `[...]` row of the first frame of its episode.
        length: L, frames in a history.

    Returns:
        `[..., L]` rows, newest first, never before the episode's first frame.
    """
    rows: Rows = np.maximum(newest[..., None] - np.arange(length), first[..., None])
    return rows


def gather_history(
    frames: NDArray[np.float32], newest: Rows, first: Rows, length: int
) -> NDArray[np.float32]:
    """Histories flattened frame by frame, newest first.

    Args:
        frames: `[rows, F]`.
        newest: `[...]` rows.
        first: `[...]` rows.
        length: L.

    Returns:
        `[..., L * F]`; values k F ... k F + F - 1 are the frame of lag k.
    """
    gathered = frames[history_rows(newest, first, length)]
    return gathered.reshape(*gathered.shape[:-2], length * frames.shape[-1])


def newest_first(episode_starts: NDArray[np.int64], length: int) -> tuple[Rows, Rows]:
    """An order of frames in which every history of ``length`` frames is a run of rows.

    Every episode is laid out from its last frame to its first, which is then repeated: where the
    episode has fewer frames than a history, the history ends in the repetitions.

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
