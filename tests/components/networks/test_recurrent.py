"""Unrolled cells with their hand-written backward pass, against a plain loop under autograd."""

import pytest
import torch
from torch import Tensor

from components.networks.recurrent import fast_tanh, unroll_cells

Operands = tuple[Tensor, Tensor, Tensor, Tensor]


def operands(dtype: torch.dtype = torch.float64, steps: int = 6) -> Operands:
    g = torch.Generator().manual_seed(0)
    cells, width, features, batch = 3, 4, 2, 5
    shapes = [(cells, width, width + features + 1), (cells, 1, width + 1), (cells, width, batch)]
    made = [(0.5 * torch.randn(s, generator=g, dtype=dtype)).requires_grad_() for s in shapes]
    return (*made, torch.randn(steps, cells, features, batch, generator=g, dtype=dtype))


def by_loop(weight: Tensor, readout: Tensor, hidden: Tensor, inputs: Tensor) -> tuple:
    width = hidden.shape[1]
    readings = []
    for x in inputs:
        recurrent, forward, bias = weight.split([width, inputs.shape[2], 1], dim=2)
        hidden = torch.tanh(recurrent @ hidden + forward @ x + bias)
        readings.append((readout[:, :, :-1] @ hidden + readout[:, :, -1:]).squeeze(1))
    return torch.stack(readings), hidden


def test_values_and_gradients_equal_the_loop() -> None:
    ours, theirs = operands(), operands()
    mix = torch.randn(6, 3, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for arguments, function in ((ours, unroll_cells), (theirs, by_loop)):
        readings, last = function(*arguments)
        ((mix * readings).sum() + last.square().sum()).backward()
    # double precision; tanh by way of the sigmoid differs in the last digits
    options = {"rtol": 1e-10, "atol": 1e-12}
    for one, other in zip(unroll_cells(*ours), by_loop(*theirs), strict=True):
        torch.testing.assert_close(one, other, **options)
    for one, other in zip(ours[:3], theirs[:3], strict=True):
        torch.testing.assert_close(one.grad, other.grad, **options)


@pytest.mark.parametrize("steps", [1, 4])
def test_gradients_equal_finite_differences(steps: int) -> None:
    weight, readout, hidden, inputs = operands(steps=steps)
    assert torch.autograd.gradcheck(
        lambda w, r, h: unroll_cells(w, r, h, inputs), (weight, readout, hidden)
    )


def test_single_precision_stays_close_to_double() -> None:
    double = unroll_cells(*operands())[0]
    single = unroll_cells(*(x.detach().float() for x in operands()))[0]
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-5)  # six float32 steps


def test_fast_tanh() -> None:
    x = torch.linspace(-20.0, 20.0, 4001)
    # two units in the last place of 1
    torch.testing.assert_close(fast_tanh(x), torch.tanh(x), rtol=0.0, atol=2.4e-7)
