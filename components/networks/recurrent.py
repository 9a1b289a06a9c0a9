"""Stacked tanh RNN cells, unrolled over known inputs with a hand-written backward pass.

Layout is feature-major, ``[M, features, B]`` for M independent cells: the batch is the contiguous
axis, so matrix products and element-wise work run over long rows even for 30 hidden units.

One step of cell m is ``h' = tanh(W_m [h; x; 1])`` with ``W [M, H, H + D + 1]``, and its reading is
``y = r_m [h'; 1]`` with ``r [M, 1, H + 1]`` (thesis 3.38 to 3.40). Three things make the unrolled
cell several times cheaper than the same loop under autograd: inputs, hidden state and the constant
one share one buffer and thus one product per step, forward and backward; nothing is sliced inside
the recorded graph (a slice of a ``[T, ...]`` tensor costs a gradient of that size per step); and
tanh is computed as ``2 sigmoid(2x) - 1``, for which PyTorch has the faster CPU kernel (largest
absolute difference to ``torch.tanh``: below two units in the last place of 1).
"""

from typing import Any

import torch
from torch import Tensor

__all__ = ["fast_tanh", "unroll_cells"]


def fast_tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent by way of the sigmoid; differentiable."""
    return 2.0 * torch.sigmoid(2.0 * x) - 1.0


class _Unroll(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, weight: Tensor, readout: Tensor, hidden: Tensor, inputs: Tensor
    ) -> tuple[Tensor, Tensor]:
        steps, cells, features, batch = inputs.shape
        width = hidden.shape[1]
        buffer = inputs.new_empty(steps + 1, cells, width + features + 1, batch)
        buffer[:-1, :, width:-1] = inputs
        buffer[:, :, -1] = 1.0
        buffer[0, :, :width] = hidden
        readings = inputs.new_empty(steps, cells, batch)
        doubled = 2.0 * weight
        activation = hidden.new_empty(cells, width, batch)
        for t in range(steps):
            torch.bmm(doubled, buffer[t], out=activation)
            activation.sigmoid_().mul_(2.0).sub_(1.0)
            buffer[t + 1, :, :width] = activation
            torch.baddbmm(
                readout[:, :, -1:], readout[:, :, :-1], activation, out=readings[t].unsqueeze(1)
            )
        ctx.save_for_backward(weight, readout, buffer)
        return readings, activation

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        grad_readings, grad_last = grads
        weight, readout, buffer = ctx.saved_tensors
        steps, width = buffer.shape[0] - 1, weight.shape[1]
        grad_weight = torch.zeros_like(weight)
        grad_readout = torch.zeros_like(readout)
        grad_hidden = grad_last.clone()
        recurrent = weight[:, :, :width].transpose(1, 2)
        emit = readout[:, :, :-1].transpose(1, 2)
        for t in range(steps - 1, -1, -1):
            hidden = buffer[t + 1, :, :width]
            reading = grad_readings[t].unsqueeze(1)
            grad_readout[:, :, :-1].baddbmm_(reading, hidden.transpose(1, 2))
            grad_hidden.baddbmm_(emit, reading)
            grad_hidden.addcmul_(grad_hidden * hidden, hidden, value=-1.0)
            grad_weight.baddbmm_(grad_hidden, buffer[t].transpose(1, 2))
            grad_hidden = torch.bmm(recurrent, grad_hidden)
        grad_readout[:, 0, -1] = grad_readings.sum(dim=(0, 2))
        return grad_weight, grad_readout, grad_hidden, None


def unroll_cells(
    weight: Tensor, readout: Tensor, hidden: Tensor, inputs: Tensor
) -> tuple[Tensor, Tensor]:
    """Run M cells over T known inputs.

    Args:
        weight: ``[M, H, H + D + 1]``, columns for the hidden state, the inputs and the bias.
        readout: ``[M, 1, H + 1]``, last column the bias.
        hidden: ``[M, H, B]`` hidden state before the first step.
        inputs: ``[T, M, D, B]``; treated as data, no gradient flows into them.

    Returns:
        Readings ``[T, M, B]`` and the last hidden state ``[M, H, B]``.
    """
    readings, last = _Unroll.apply(weight, readout, hidden, inputs)  # type: ignore[no-untyped-call]
    return readings, last
