"""Unrolled cells with their hand-written backward pass, against a plain loop under autograd."""

import pytest
import torch
from torch import Tensor

from components.networks.recurrent import logistic_cells, unroll_cells, unroll_loops

Operands = tuple[Tensor, Tensor, Tensor, Tensor]


def operands(
    dtype: torch.dtype = torch.float64, steps: int = 6, outputs: int = 1, looped: int = 0
) -> Operands:
    g = torch.Generator().manual_seed(0)
    cells, width, features, batch = 3, 4, 2, 5
    columns = width + features + looped + 1
    shapes = [(cells, width, columns), (cells, outputs, width + 1), (cells, width, batch)]
    made = [(0.5 * torch.randn(s, generator=g, dtype=dtype)).requires_grad_() for s in shapes]
    return (*made, torch.randn(steps, cells, features, batch, generator=g, dtype=dtype))


def by_loop(weight: Tensor, readout: Tensor, hidden: Tensor, inputs: Tensor) -> tuple:
    width = hidden.shape[1]
    readings = []
    for x in inputs:
        recurrent, forward, bias = weight.split([width, inputs.shape[2], 1], dim=2)
        hidden = torch.tanh(recurrent @ hidden + forward @ x + bias)
        readings.append((readout[:, :, :-1] @ hidden + readout[:, :, -1:]).flatten(0, 1))
    return torch.stack(readings), hidden


@pytest.mark.parametrize("outputs", [1, 3])
def test_values_and_gradients_equal_the_loop(outputs: int) -> None:
    ours, theirs = operands(outputs=outputs), operands(outputs=outputs)
    g = torch.Generator().manual_seed(1)
    mix = torch.randn(6, 3 * outputs, 5, generator=g, dtype=torch.float64)
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


def loops_by_hand(
    weight: Tensor,
    readout: Tensor,
    hidden: Tensor,
    inputs: Tensor,
    own: Tensor,
    reads: Tensor,
    adds: Tensor,
) -> tuple:
    width, looped = hidden.shape[1], own.shape[1]
    values = []
    for x in inputs:
        recurrent, forward, bias = weight.split([width, x.shape[1] + looped, 1], dim=2)
        hidden = torch.tanh(recurrent @ hidden + forward @ torch.cat([x, own], dim=1) + bias)
        read = readout[:, :, :-1] @ hidden + readout[:, :, -1:]
        carried = read[:, :looped] + adds * own
        own = reads * carried
        values.append(torch.cat([carried, read[:, looped:]], dim=1).flatten(0, 1))
    return torch.stack(values), hidden


def test_loops_carry_values_and_sums_of_readings() -> None:
    """One cell adds up its first reading, takes its second as it is; another reads neither."""
    ours, theirs = (operands(outputs=3, looped=2) for _ in range(2))
    reads = torch.tensor([[1.0, 1.0], [0.0, 0.0], [1.0, 0.0]]).double()[:, :, None]
    adds = torch.tensor([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]).double()[:, :, None]
    g = torch.Generator().manual_seed(1)
    mix = torch.randn(6, 9, 5, generator=g, dtype=torch.float64)
    start = reads * torch.randn(3, 2, 5, generator=g, dtype=torch.float64)
    found = []
    for arguments, function in ((ours, unroll_loops), (theirs, loops_by_hand)):
        own = start.clone().requires_grad_()
        values, last = function(*arguments, own, reads, adds)
        ((mix * values).sum() + last.square().sum()).backward()
        found.append((values, last, own.grad, *(x.grad for x in arguments[:3])))
    for one, other in zip(*found, strict=True):
        # double precision; tanh by way of the sigmoid differs in the last digits
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


def test_loops_that_read_nothing_are_plain_cells() -> None:
    weight, readout, hidden, inputs = operands(outputs=2, looped=1)
    nothing = torch.zeros(3, 1, 5).double()
    found, _ = unroll_loops(weight, readout, hidden, inputs, nothing, *[nothing[:, :, :1]] * 2)
    shorter = torch.cat([weight[:, :, :6], weight[:, :, -1:]], dim=2)
    torch.testing.assert_close(found, unroll_cells(shorter, readout, hidden, inputs)[0])


def test_without_any_step_the_hidden_state_stays() -> None:
    weight, readout, hidden, inputs = operands()
    readings, last = unroll_cells(weight, readout, hidden, inputs[:0])
    assert readings.shape == (0, 3, 5)
    assert torch.equal(last, hidden)


def test_single_precision_stays_close_to_double() -> None:
    double = unroll_cells(*operands())[0]
    single = unroll_cells(*(x.detach().float() for x in operands()))[0]
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-5)  # six float32 steps


@pytest.mark.parametrize("outputs", [1, 3])
def test_logistic_cells_read_out_the_same(outputs: int) -> None:
    weight, readout, hidden, inputs = operands(outputs=outputs)
    expected, last = by_loop(weight, readout, hidden, inputs)
    step, emit = logistic_cells(weight, readout)
    state, ones = (hidden + 1.0) / 2.0, torch.ones_like(hidden[:, :1])
    for x, readings in zip(inputs, expected, strict=True):
        state = torch.sigmoid(step @ torch.cat([state, x, ones], dim=1))
        found = emit @ torch.cat([state, ones], dim=1)
        torch.testing.assert_close(found.flatten(0, 1), readings)
    torch.testing.assert_close(2.0 * state - 1.0, last)


def test_the_activation_is_tanh() -> None:
    x = torch.linspace(-20.0, 20.0, 4001)
    weight, readout = torch.tensor([[[0.0, 1.0, 0.0]]]), torch.tensor([[[1.0, 0.0]]])
    readings, last = unroll_cells(weight, readout, torch.zeros(1, 1, 4001), x.view(1, 1, 1, -1))
    # two units in the last place of 1
    for found in (readings.flatten(), last.flatten()):
        torch.testing.assert_close(found, torch.tanh(x), rtol=0.0, atol=2.4e-7)
