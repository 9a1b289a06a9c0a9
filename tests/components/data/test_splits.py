"""Held-out episodes and the statistics of the others."""

import dataclasses

import numpy as np
import pytest

from components.data.catalogue import DATASETS, generate
from components.data.dataset import OfflineDataset
from components.data.splits import frame_statistics, split_episodes


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return generate(
        dataclasses.replace(DATASETS["mediocre-1.0"], trajectories=10, steps=30), seed=0
    )


@pytest.mark.parametrize(("fraction", "boundary"), [(0.1, 9), (0.3, 7), (0.01, 9), (0.99, 1)])
def test_last_episodes_are_held_out(
    dataset: OfflineDataset, fraction: float, boundary: int
) -> None:
    split = split_episodes(dataset, fraction)
    assert split.train == range(boundary)
    assert split.held_out == range(boundary, 10)


def test_statistics_see_only_the_named_episodes(dataset: OfflineDataset) -> None:
    statistics = frame_statistics(dataset, range(2, 5))
    frames = dataset.frames[2 * 31 : 5 * 31].astype(np.float64)
    np.testing.assert_allclose(statistics.mean, frames.mean(axis=0))
    np.testing.assert_allclose(statistics.std[1:], frames.std(axis=0)[1:])
    assert statistics.std[0] == 1.0  # the setpoint never changes


def test_impossible_splits_are_refused(dataset: OfflineDataset) -> None:
    for fraction in (0.0, 1.0):
        with pytest.raises(ValueError, match="between 0 and 1"):
            split_episodes(dataset, fraction)
    single = generate(dataclasses.replace(DATASETS["bad-0.0"], trajectories=1, steps=5), 0)
    with pytest.raises(ValueError, match="single episode"):
        split_episodes(single)
    for episodes in (range(0), range(5, 11)):
        with pytest.raises(ValueError, match="not a run of the 10 episodes"):
            frame_statistics(dataset, episodes)
