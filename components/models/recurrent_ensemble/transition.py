"""Recurrent ensembles of L lanes as a transition model, all networks in one stack.

Hidden states have the form of :func:`components.networks.recurrent.logistic_cells`: apart from the
matrix products, tanh took most of the time of a step.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.transition.interface import Prediction
from components.networks.recurrent import logistic_cells, unroll_cells

__all__ = ["RecurrentTransition"]


class RecurrentTransition:
    """K networks of every group a lane; every network keeps its own hidden state.

    Args:
        ensembles: One per lane, of equal shapes and equal feedback.
        device: Where to compute.
    """

    def __init__(self, ensembles: Sequence[RecurrentEnsemble], device: torch.device) -> None:
        first = ensembles[0]
        self.members, self.memory = first.members, first.warm_up
        self.frames = Normaliser.stack([e.frames for e in ensembles]).to(device)
        self.low = torch.stack([e.low for e in ensembles]).to(device)
        self.high = torch.stack([e.high for e in ensembles]).to(device)
        self.target_scale = torch.ones_like(self.low)
        # [L * M, H, ...]; the columns of values that a group does not read back are set to zero.
        self._weight = torch.cat([e.weight for e in ensembles]).to(device)
        self._readout = torch.cat([e.readout for e in ensembles]).to(device)
        # Groups, members, outputs: the axes of what all networks of a lane read out.
        self._shape = (len(first.feedback.reads), self.members, first.readout.shape[1])
        reads, adds = first.feedback.reads.to(device), first.feedback.adds.to(device)
        self._looped = reads.shape[1]
        of_networks = reads.repeat_interleave(self.members, dim=0).repeat(len(ensembles), 1)
        self._weight[:, :, -1 - self._looped : -1] *= of_networks[:, None]
        self._logistic, self._emit = logistic_cells(self._weight, self._readout)
        every = torch.zeros(self._shape[0], self._shape[2], device=device)
        every[:, : self._looped] = adds
        self._adds = every.view(1, -1, 1, 1) if first.feedback.sums else None

    def _own(self, previous: Tensor) -> Tensor:
        """Previous values that every group's networks read, ``[..., groups, S, D', B]``.

        Args:
            previous: ``[..., D, S, B]`` normalised.
        """
        groups, _, outputs = self._shape
        by_group: Tensor = previous.unflatten(-3, (groups, outputs)).transpose(-3, -2)
        return by_group[..., : self._looped, :]

    @torch.no_grad()
    def begin(self, past: Tensor) -> Tensor:
        """Logistic states ``[L * M, H, B]`` after the model frames ``[L, S, B, T, F]``."""
        lanes, _, batch, length, features = past.shape
        known = features - self.low.shape[1]
        mean, scale = (s[:, None, None, None] for s in (self.frames.mean, self.frames.scale))
        oldest_first = ((past - mean) / scale).flip(3).permute(3, 0, 4, 1, 2)  # [T, L, F, S, B]
        posterior = oldest_first[1:, :, None, :known].transpose(3, 4)
        own = self._own(oldest_first[:-1, :, known:])
        shape = (length - 1, lanes, *self._shape[:2])
        inputs = torch.cat(
            [
                posterior.expand(*shape, known, batch),
                own.expand(*shape, self._looped, batch),
            ],
            dim=4,
        )
        start = past.new_zeros(self._weight.shape[0], self._weight.shape[1], batch)
        _, hidden = unroll_cells(self._weight, self._readout, start, inputs.flatten(1, 3))
        return (hidden + 1.0) / 2.0

    def predict(
        self, state: Tensor, observation: Tensor, known: Tensor, own: Tensor
    ) -> tuple[Prediction, Tensor]:
        """One step of all members; ``state`` is the logistic one, or see :meth:`_in_place`."""
        if not torch.is_grad_enabled():
            return self._in_place(state, known, own)
        lanes, _, batch, features = known.shape
        shape = (lanes, *self._shape[:2])
        seen = torch.cat(
            [
                state.view(*shape, -1, batch),
                known.transpose(2, 3)[:, None].expand(*shape, features, batch),
                self._own(own).expand(*shape, self._looped, batch),
                known.new_ones(()).expand(*shape, 1, batch),
            ],
            dim=3,
        ).flatten(0, 2)
        return self._read(torch.bmm(self._logistic, seen).sigmoid(), own)

    def _in_place(self, state: Tensor, known: Tensor, own: Tensor) -> tuple[Prediction, Tensor]:
        """The same without gradients, with all inputs of the cells in one buffer.

        From the first step on the state is that buffer ``[L * M, H + known + D' + 1, B]``: logistic
        state, known features, own values and the constant one. Each step overwrites it.
        """
        lanes, _, batch, features = known.shape
        cells, width, columns = self._logistic.shape
        if state.shape[1] == width:
            buffer = state.new_ones(cells, columns, batch)
            buffer[:, :width] = state
        else:
            buffer = state
        given = buffer[:, width:-1].view(lanes, *self._shape[:2], -1, batch)
        given[..., :features, :] = known.transpose(2, 3)[:, None]
        given[..., features:, :] = self._own(own)
        logistic = buffer[:, :width]
        torch.sigmoid(torch.bmm(self._logistic, buffer), out=logistic)
        return self._read(logistic, own)[0], buffer

    def _read(self, logistic: Tensor, own: Tensor) -> tuple[Prediction, Tensor]:
        """All members' predictions from states ``[L * M, H, B]``, which are returned too."""
        read = torch.baddbmm(self._emit[:, :, -1:], self._emit[:, :, :-1], logistic)
        by_member = read.view(len(own), *self._shape, -1).transpose(2, 3)
        values = by_member.reshape(len(own), -1, self.members, read.shape[-1])  # [L, D, K, B]
        if self._adds is not None:
            values = values + self._adds * own
        return Prediction(values), logistic
