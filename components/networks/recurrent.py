"""Stacked tanh RNN cells, unrolled over known inputs with a hand-written backward pass.

Layout is feature-major, ``[M, features, B]`` for M independent cells: the batch is the contiguous
axis, so matrix products and element-wise work run over long rows even for 30 hidden units.

One step of cell m is ``h' = tanh(W_m [h; x; 1])`` with ``W [M, H, H + D + 1]``, and its readings
are ``y = R_m [h'; 1]`` with ``R [M, O, H + 1]`` (thesis 3.38 to 3.40). Three things make the
unrolled cell several times cheaper than the same loop under autograd: inputs, hidden state and the
constant one share one buffer and thus one product per step, forward and backward; nothing is sliced
inside the recorded graph (a slice of a ``[T, ...]`` tensor costs a gradient of that size per step);
and tanh is computed as ``2 sigmoid(2x) - 1``, whose kernel is the faster one on some processors (an
AMD EPYC; not on an AVX-512 Xeon) and whose numbers are kept the same everywhere (largest absolute
difference to ``torch.tanh``: below two units in the last place of 1).

A cell may also take its own readings as inputs: its last D' inputs are then values ``o`` that it
carries from step to step, ``o' = reads * (y + adds * o)``, where y are its first D' readings. With
``adds`` they are sums of all readings so far, which no recurrent matrix can express.
"""

from typing import Any

import torch
from torch import Tensor

__all__ = ["logistic_cells", "unroll_cells", "unroll_loops"]


def logistic_cells(weight: Tensor, readout: Tensor) -> tuple[Tensor, Tensor]:
    """The same cells with the hidden state ``s = (h + 1) / 2``.

    A step then is ``s' = sigmoid(V [s; x; 1])`` and nothing else is computed per element, and its
    readings are ``S [s'; 1]``.

    Args:
        weight: ``[M, H, H + D + 1]``.
        readout: ``[M, O, H + 1]``.

    Returns:
        V and S, shaped like them.
    """
    width = weight.shape[1]
    recurrent, inputs, bias = weight.split([width, weight.shape[2] - width - 1, 1], dim=2)
    bias = bias - recurrent.sum(dim=2, keepdim=True)
    emit, offset = readout.split([width, 1], dim=2)
    offset = offset - emit.sum(dim=2, keepdim=True)
    return (
        torch.cat([4.0 * recurrent, 2.0 * inputs, 2.0 * bias], dim=2),
        torch.cat([2.0 * emit, offset], dim=2),
    )


class _Unroll(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        weight: Tensor,
        readout: Tensor,
        hidden: Tensor,
        inputs: Tensor,
        own: Tensor | None,
        reads: Tensor | None,
        adds: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        steps, cells, features, batch = inputs.shape
        width, outputs = hidden.shape[1], readout.shape[1]
        buffer = inputs.new_empty(steps + 1, cells, weight.shape[2], batch)
        buffer[:-1, :, width : width + features] = inputs
        buffer[:, :, -1] = 1.0
        buffer[0, :, :width] = hidden
        if own is not None:
            buffer[0, :, width + features : -1] = own
        readings = inputs.new_empty(steps, cells, outputs, batch)
        doubled = 2.0 * weight
        activation = hidden.clone()  # the result if there are no steps
        for t in range(steps):
            torch.bmm(doubled, buffer[t], out=activation)
            activation.sigmoid_().mul_(2.0).sub_(1.0)
            buffer[t + 1, :, :width] = activation
            torch.baddbmm(readout[:, :, -1:], readout[:, :, :-1], activation, out=readings[t])
            if reads is not None and adds is not None:
                looped = readings[t, :, : reads.shape[1]]
                looped.addcmul_(adds, buffer[t, :, width + features : -1])
                torch.mul(looped, reads, out=buffer[t + 1, :, width + features : -1])
        ctx.save_for_backward(weight, readout, buffer, reads, adds)
        ctx.features = features
        return readings.flatten(1, 2), activation

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        grad_readings, grad_last = grads
        weight, readout, buffer, reads, adds = ctx.saved_tensors
        steps, width = buffer.shape[0] - 1, weight.shape[1]
        grad_readings = grad_readings.unflatten(1, readout.shape[:2])
        grad_weight = torch.zeros_like(weight)
        grad_readout = torch.zeros_like(readout)
        grad_hidden = grad_last.clone()
        recurrent = weight[:, :, :width].transpose(1, 2)
        emit = readout[:, :, :-1].transpose(1, 2)
        grad_own: Tensor | None = None
        if reads is not None:
            grad_readings = grad_readings.clone()  # gradients through the loop are added in place
            loop = weight[:, :, width + ctx.features : -1].transpose(1, 2)
            grad_own = torch.zeros_like(buffer[0, :, width + ctx.features : -1])
        for t in range(steps - 1, -1, -1):
            hidden = buffer[t + 1, :, :width]
            if grad_own is not None:
                grad_readings[t, :, : reads.shape[1]].addcmul_(grad_own, reads)
            reading = grad_readings[t]
            grad_readout[:, :, :-1].baddbmm_(reading, hidden.transpose(1, 2))
            grad_hidden.baddbmm_(emit, reading)
            grad_hidden.addcmul_(grad_hidden * hidden, hidden, value=-1.0)
            grad_weight.baddbmm_(grad_hidden, buffer[t].transpose(1, 2))
            if grad_own is not None:
                grad_own = torch.bmm(loop, grad_hidden).addcmul_(adds, reading[:, : reads.shape[1]])
            grad_hidden = torch.bmm(recurrent, grad_hidden)
        grad_readout[:, :, -1] = grad_readings.sum(dim=(0, 3))
        return grad_weight, grad_readout, grad_hidden, None, grad_own, None, None


def unroll_cells(
    weight: Tensor, readout: Tensor, hidden: Tensor, inputs: Tensor
) -> tuple[Tensor, Tensor]:
    """Run M cells over T known inputs.

    Args:
        weight: ``[M, H, H + D + 1]``, columns for the hidden state, the inputs and the bias.
        readout: ``[M, O, H + 1]``, last column the bias.
        hidden: ``[M, H, B]`` hidden state before the first step.
        inputs: ``[T, M, D, B]``; treated as data, no gradient flows into them.

    Returns:
        Readings ``[T, M * O, B]``, cell by cell, and the last hidden state ``[M, H, B]``.
    """
    readings, last = _Unroll.apply(  # type: ignore[no-untyped-call]
        weight, readout, hidden, inputs, None, None, None
    )
    return readings, last


def unroll_loops(
    weight: Tensor,
    readout: Tensor,
    hidden: Tensor,
    inputs: Tensor,
    own: Tensor,
    reads: Tensor,
    adds: Tensor,
) -> tuple[Tensor, Tensor]:
    """Run M cells whose first D' readings are inputs of the next step.

    Args:
        weight: ``[M, H, H + D + D' + 1]``, columns for the hidden state, the inputs, the loop and
            the bias.
        readout: ``[M, O, H + 1]``, O at least D'.
        hidden: ``[M, H, B]`` hidden state before the first step.
        inputs: ``[T, M, D, B]``; treated as data.
        own: ``[M, D', B]`` values carried into the first step.
        reads: ``[M, D', 1]`` 0 where a value is not carried on.
        adds: ``[M, D', 1]`` 1 where a reading is added to the value carried, 0 where it takes its
            place.

    Returns:
        Values ``[T, M * O, B]``, the readings with the carried value added where ``adds`` is 1, and
        the last hidden state ``[M, H, B]``.
    """
    values, last = _Unroll.apply(  # type: ignore[no-untyped-call]
        weight, readout, hidden, inputs, own, reads, adds
    )
    return values, last
