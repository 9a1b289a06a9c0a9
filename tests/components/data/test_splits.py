"""Held-out episodes."""

import numpy as np
import pytest

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.data.splits import split_episodes


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return generate(
        IndustrialSpec("mediocre-1.0", "mediocre", 1.0, trajectories=10, steps=30), seed=0
    )


@pytest.mark.parametrize(("fraction", "boundary"), [(0.1, 9), (0.3, 7), (0.01, 9), (0.99, 1)])
def test_last_episodes_are_held_out(
    dataset: OfflineDataset, fraction: float, boundary: int
) -> None:
    split = split_episodes(dataset, fraction)
    assert split.train == range(boundary)
    assert split.held_out == range(boundary, 10)
    assert split.trained_transitions(dataset) == 30 * boundary
    assert split.trained_frames(dataset) == 31 * boundary
    mean = dataset.frames[: 31 * boundary].mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(split.scaling(dataset).mean, mean, rtol=1e-6)  # float32


def test_impossible_splits_are_refused(dataset: OfflineDataset) -> None:
    for fraction in (0.0, 1.0):
        with pytest.raises(ValueError, match="between 0 and 1"):
            split_episodes(dataset, fraction)
    single = generate(IndustrialSpec("bad-0.0", "bad", 0.0, trajectories=1, steps=5), 0)
    with pytest.raises(ValueError, match="single episode"):
        split_episodes(single)
