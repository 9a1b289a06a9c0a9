"""BEAR's discrepancy of two samples, against plain loops and by hand."""

import math

import numpy as np
import pytest
import torch

from components.algorithms.bear import mean_discrepancy
from tests.components.algorithms.plain import discrepancy_by_loops, floats


@pytest.mark.parametrize("sigma", [0.3, 20.0])
@pytest.mark.parametrize("kernel", ["laplacian", "gaussian"])
def test_discrepancy_by_loops(kernel: str, sigma: float) -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, 4, 2, generator=generator, dtype=torch.float64)
    y = 0.5 + 2.0 * torch.randn(2, 3, 5, 2, generator=generator, dtype=torch.float64)
    found = mean_discrepancy(x, y, kernel, sigma)
    assert found.shape == (2, 3)
    for lane, i in np.ndindex(2, 3):
        expected = discrepancy_by_loops(floats(x)[lane, i], floats(y)[lane, i], kernel, sigma)
        assert found[lane, i].item() == pytest.approx(expected, rel=1e-9)  # double


def test_discrepancy_of_two_points_by_hand() -> None:
    x, y = torch.zeros(1, 1, 1, 2), torch.tensor([[[[3.0, -1.0]]]])
    # distances 3 + 1 and 9 + 1, over 2 sigma = 4
    for kernel, exponent in (("laplacian", -1.0), ("gaussian", -2.5)):
        expected = math.sqrt(1.0 + 1.0 - 2.0 * math.exp(exponent) + 1e-6)
        found = mean_discrepancy(x, y, kernel, 2.0)
        assert found.item() == pytest.approx(expected, rel=1e-6)  # float32


@pytest.mark.parametrize("kernel", ["laplacian", "gaussian"])
def test_equal_samples_leave_the_root_differentiable(kernel: str) -> None:
    x = torch.randn(1, 2, 4, 3, generator=torch.Generator().manual_seed(0))
    y = x.flip(2).clone().requires_grad_()
    found = mean_discrepancy(x, y, kernel, 20.0)
    # 1e-3, with the rounding of means near 1 in float32 beside 1e-6
    assert found.tolist()[0] == pytest.approx([1e-3, 1e-3], rel=0.2)
    assert torch.autograd.grad(found.sum(), y)[0].isfinite().all()
