"""Scaling of features."""

import numpy as np
import torch

from components.core.normaliser import Normaliser


def test_statistics_and_inverse() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, (500, 2)).astype(np.float32)
    scaling = Normaliser.fit(values)
    scaled = scaling.apply(torch.from_numpy(values))
    # float32 rounding of 500 summands
    np.testing.assert_allclose(scaled.mean(dim=0), [0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(scaled.std(dim=0, correction=0), [1.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(scaling.invert(scaled), values, atol=1e-5)


def test_a_constant_feature_scales_to_zero_whatever_epsilon() -> None:
    values = np.full((1000, 1), 70.1, np.float32)  # not exact in binary: a naive mean is off
    for epsilon in (0.0, 1e-3):
        scaling = Normaliser.fit(values, epsilon)
        assert scaling.apply(torch.from_numpy(values)).abs().max() == 0.0
        assert float(scaling.scale[0]) == 1.0


def test_epsilon_is_added_to_the_deviation() -> None:
    values = np.array([[0.0], [2.0]], np.float32)
    assert float(Normaliser.fit(values, 0.5).scale[0]) == 1.5
