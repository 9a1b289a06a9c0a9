"""Recurrent ensembles of L lanes as a transition model, all networks in one stack."""

from collections.abc import Sequence

import torch
from torch import Tensor

from components.data.normaliser import Normaliser
from components.models.recurrent_ensemble import RecurrentEnsemble
from components.models.rollout import INPUTS, TARGETS, Prediction
from components.networks.recurrent import fast_tanh, unroll_cells

__all__ = ["RecurrentTransition"]


class RecurrentTransition:
    """K pairs of networks a lane; every member keeps its own hidden state.

    Args:
        ensembles: One per lane, of equal shapes.
        device: Where to compute.
    """

    def __init__(self, ensembles: Sequence[RecurrentEnsemble], device: torch.device) -> None:
        self.members = ensembles[0].members
        self.frames = Normaliser.stack([e.frames for e in ensembles]).to(device)
        self.low = torch.stack([e.low for e in ensembles]).to(device)
        self.high = torch.stack([e.high for e in ensembles]).to(device)
        self.target_scale = torch.ones_like(self.low)
        self._weight = torch.cat([e.weight for e in ensembles]).to(device)  # [L * 2K, H, H + 6]
        self._readout = torch.cat([e.readout for e in ensembles]).to(device)
        # The fatigue networks (first half) read their previous value, the others read zero.
        self._feeds_back = torch.tensor([1.0, 0.0], device=device)[None, :, None, None, None]

    @torch.no_grad()
    def begin(self, history: Tensor) -> Tensor:
        """Hidden states ``[L * 2K, H, B]`` after the recorded frames ``[L, S, B, T, F]``."""
        lanes, _, batch, length, _ = history.shape
        mean, scale = (s[:, None, None, None] for s in (self.frames.mean, self.frames.scale))
        oldest_first = ((history - mean) / scale).flip(3).permute(3, 0, 1, 4, 2)  # [T, L, S, F, B]
        posterior = oldest_first[1:, :, None, :, : len(INPUTS)]
        previous = oldest_first[:-1, :, :, len(INPUTS) :].transpose(2, 3)[..., None, :]
        shape = (length - 1, lanes, len(TARGETS), self.members)
        inputs = torch.cat(
            [
                posterior.expand(*shape, len(INPUTS), batch),
                (previous * self._feeds_back).expand(*shape, 1, batch),
            ],
            dim=4,
        )
        start = history.new_zeros(self._weight.shape[0], self._weight.shape[1], batch)
        _, hidden = unroll_cells(self._weight, self._readout, start, inputs.flatten(1, 3))
        return hidden

    def predict(
        self, state: Tensor, observation: Tensor, inputs: Tensor, own: Tensor
    ) -> tuple[Prediction, Tensor]:
        """One step of all members; ``state`` is the hidden state, or see :meth:`_in_place`."""
        if not torch.is_grad_enabled():
            return self._in_place(state, inputs, own)
        lanes, _, batch, _ = inputs.shape
        shape = (lanes, len(TARGETS), self.members)
        fed = (own[:, :, :, None] * self._feeds_back).expand(*shape, 1, batch)
        seen = torch.cat(
            [
                state.view(*shape, -1, batch),
                inputs.transpose(2, 3)[:, None].expand(*shape, len(INPUTS), batch),
                fed,
                torch.ones_like(fed),
            ],
            dim=3,
        ).flatten(0, 2)
        hidden = fast_tanh(torch.bmm(self._weight, seen))
        read = torch.baddbmm(self._readout[:, :, -1:], self._readout[:, :, :-1], hidden)
        return Prediction(read.view(*shape, batch)), hidden

    def _in_place(self, state: Tensor, inputs: Tensor, own: Tensor) -> tuple[Prediction, Tensor]:
        """The same without gradients; from the first step on, all that is read has one buffer.

        The state is that buffer ``[L * 2K, H + 6, B]``: hidden state, inputs, own value and the
        constant one, each step's over those of the step before.
        """
        lanes, _, batch, _ = inputs.shape
        cells, width, features = self._weight.shape
        if state.shape[1] == width:
            buffer = state.new_ones(cells, features, batch)
            buffer[:, :width] = state
        else:
            buffer = state
        shape = (lanes, len(TARGETS), self.members)
        given = buffer[:, width:-1].view(*shape, -1, batch)
        given[..., :-1, :] = inputs.transpose(2, 3)[:, None]
        given[..., -1:, :] = own[:, :, :, None] * self._feeds_back
        hidden = buffer[:, :width]
        torch.tanh(torch.bmm(self._weight, buffer), out=hidden)
        read = torch.baddbmm(self._readout[:, :, -1:], self._readout[:, :, :-1], hidden)
        return Prediction(read.view(*shape, batch)), buffer
