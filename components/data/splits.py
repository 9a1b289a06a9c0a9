"""Which episodes a supervised model may see, and the statistics of what it sees.

The last tenth of the trajectories is held out. Normalisers are fitted on the others, so that
nothing of the held-out data reaches a model.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset

__all__ = ["EpisodeSplit", "FrameStatistics", "frame_statistics", "split_episodes"]


@dataclass(frozen=True)
class EpisodeSplit:
    """Episodes for training and the held-out ones after them."""

    train: range
    held_out: range


@dataclass(frozen=True)
class FrameStatistics:
    """Mean and standard deviation of each frame value.

    Attributes:
        mean: `[F]` float64.
        std: `[F]` float64; 1 where the value is constant, so that dividing by it is harmless.
    """

    mean: NDArray[np.float64]
    std: NDArray[np.float64]


def split_episodes(dataset: OfflineDataset, fraction: float = 0.1) -> EpisodeSplit:
    """Hold out the last episodes.

    Args:
        dataset: with at least two episodes.
        fraction: share of the episodes to hold out, rounded up to at least one, at most all but
            one.

    Raises:
        ValueError: a fraction outside (0, 1) or a dataset of a single episode.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"held-out fraction is {fraction}; give a number between 0 and 1.")
    if dataset.episodes < 2:
        raise ValueError(
            f"dataset {dataset.card.name!r} has a single episode; holding one out needs two."
        )
    count = min(max(1, math.ceil(dataset.episodes * fraction - 1e-9)), dataset.episodes - 1)
    boundary = dataset.episodes - count
    return EpisodeSplit(train=range(boundary), held_out=range(boundary, dataset.episodes))


def frame_statistics(dataset: OfflineDataset, episodes: range) -> FrameStatistics:
    """Mean and deviation over all frames of a run of consecutive episodes.

    Args:
        dataset: any dataset.
        episodes: consecutive episodes, e.g. `EpisodeSplit.train`.

    Raises:
        ValueError: no episodes, or episodes that the dataset does not have.
    """
    if len(episodes) == 0 or episodes.step != 1 or episodes[-1] >= dataset.episodes:
        raise ValueError(
            f"{episodes} is not a run of the {dataset.episodes} episodes of {dataset.card.name!r}."
        )
    begin = int(dataset.episode_starts[episodes.start]) + episodes.start
    end = int(dataset.episode_starts[episodes.stop]) + episodes.stop
    frames = np.asarray(dataset.frames[begin:end], dtype=np.float64)
    std = frames.std(axis=0)
    # a constant float32 value has a deviation of rounding, not of zero
    constant = np.ptp(frames, axis=0) == 0.0
    return FrameStatistics(mean=frames.mean(axis=0), std=np.where(constant, 1.0, std))
