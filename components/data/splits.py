"""The split of a log for supervised models: the last episodes are held out for validation."""

import math
from dataclasses import dataclass

import numpy as np

from components.core.normaliser import Normaliser
from components.data.dataset import OfflineDataset

__all__ = ["EpisodeSplit", "split_episodes"]


@dataclass(frozen=True)
class EpisodeSplit:
    """Episodes for training and the held-out ones after them."""

    train: range
    held_out: range

    def trained_transitions(self, dataset: OfflineDataset) -> int:
        """Number of transitions in the training episodes; they are the dataset's first ones."""
        return int(dataset.episode_starts[self.train.stop])

    def trained_frames(self, dataset: OfflineDataset) -> int:
        """Number of frames in the training episodes, one more than transitions in each."""
        return self.trained_transitions(dataset) + self.train.stop

    def scaling(self, dataset: OfflineDataset) -> Normaliser:
        """Scaling by the frames of the training episodes.

        Models are chosen by held-out losses, so the held-out frames must not scale what they read.
        """
        return Normaliser.fit(np.asarray(dataset.frames[: self.trained_frames(dataset)]))


def split_episodes(dataset: OfflineDataset, fraction: float = 0.1, least: int = 1) -> EpisodeSplit:
    """Hold out the last episodes.

    Args:
        dataset: with at least two episodes.
        fraction: share of the episodes to hold out, rounded up.
        least: episodes that both sides get at least, if there are enough; otherwise one.

    Raises:
        ValueError: a fraction outside (0, 1) or a dataset of a single episode.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"held-out fraction is {fraction}; give a number between 0 and 1.")
    if dataset.episodes < 2:
        raise ValueError(
            f"dataset {dataset.card.name!r} has a single episode; holding one out needs two."
        )
    if dataset.episodes < 2 * least:
        least = 1
    wanted = math.ceil(dataset.episodes * fraction - 1e-9)
    count = min(max(least, wanted), dataset.episodes - least)
    boundary = dataset.episodes - count
    return EpisodeSplit(train=range(boundary), held_out=range(boundary, dataset.episodes))
