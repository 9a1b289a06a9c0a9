"""Stacks of independent networks, the building block of every learner.

A stack holds L copies of a network in tensors whose first axis is the *lane* axis: weights
``[L, in, out]``, activations ``[L, B, features]``, one ``torch.baddbmm`` per layer. Losses that are
averaged inside a lane and summed over lanes give every lane exactly the gradient it would have had
alone, so one element-wise optimiser (Adam, SGD) trains them all. Twin critics and ensemble members
are lanes as well: ``[L * K, ...]`` viewed as ``[L, K, ...]``.

Initial weights are PyTorch's default for linear layers, uniform in +-1/sqrt(fan in), drawn per lane
from that lane's own generator.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

__all__ = [
    "StackedLinear",
    "StackedMLP",
    "first_layer_over_actions",
    "lane_groups",
    "lanewise_mean",
    "polyak_update",
    "select_lanes",
]

Module = TypeVar("Module", bound=nn.Module)
Activation = Callable[[Tensor], Tensor]


class StackedLinear(nn.Module):
    """L affine maps side by side: ``[L, B, in] -> [L, B, out]``."""

    def __init__(
        self, generators: Sequence[np.random.Generator], inputs: int, outputs: int
    ) -> None:
        super().__init__()
        bound = inputs**-0.5
        weights = [g.uniform(-bound, bound, (inputs + 1, outputs)) for g in generators]
        stacked = torch.from_numpy(np.stack(weights)).float()
        self.weight = nn.Parameter(stacked[:, :inputs].clone())
        self.bias = nn.Parameter(stacked[:, inputs:].clone())

    def forward(self, x: Tensor) -> Tensor:
        """Apply lane l's map to ``x[l]``."""
        return torch.baddbmm(self.bias, x, self.weight)


class StackedMLP(nn.Module):
    """L multilayer perceptrons side by side.

    Args:
        generators: One generator per lane, consumed for the initial weights.
        sizes: Layer widths from input to output, e.g. ``(180, 256, 256, 3)``.
        activation: Applied after every hidden layer, in place if it can; the output is linear.
    """

    def __init__(
        self,
        generators: Sequence[np.random.Generator],
        sizes: Sequence[int],
        activation: Activation = torch.relu_,
    ) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            StackedLinear(generators, inputs, outputs) for inputs, outputs in pairwise(sizes)
        )
        self._activation = activation

    @property
    def lanes(self) -> int:
        """Number of stacked copies L."""
        return len(self.affine()[0][0])

    def affine(self) -> list[tuple[nn.Parameter, nn.Parameter]]:
        """Weight ``[L, in, out]`` and bias ``[L, 1, out]`` of every layer, input to output."""
        return [(m.weight, m.bias) for m in self.layers if isinstance(m, StackedLinear)]

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[L, B, in]`` to ``[L, B, out]``."""
        return self._from_layer(0, x)

    def over_actions(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Evaluate N actions at each observation; its part of the first layer is computed once.

        Equals the forward pass on every pair: the first layer is linear in its input, so its
        product with an observation serves all actions tried there.

        Args:
            observations: ``[L, B, O]``.
            actions: ``[L, B, N, A]``, the last inputs of the network.

        Returns:
            ``[L, B, N, out]``.
        """
        x = first_layer_over_actions(*self.affine()[0], observations, actions)
        if len(self.layers) > 1:
            x = self._from_layer(1, self._activation(x))
        return x.view(*actions.shape[:3], -1)

    def _from_layer(self, first: int, x: Tensor) -> Tensor:
        *hidden, last = list(self.layers)[first:]
        for layer in hidden:
            x = self._activation(layer(x))
        out: Tensor = last(x)
        return out


def first_layer_over_actions(
    weight: Tensor, bias: Tensor, observations: Tensor, actions: Tensor
) -> Tensor:
    """A first layer before its activation, ``[L, B * N, H]``, see :meth:`StackedMLP.over_actions`.

    Its gradient with respect to actions costs a product with the actions' few weights alone.

    Args:
        weight: ``[L, O + A, H]``.
        bias: ``[L, 1, H]``.
        observations: ``[L, B, O]``.
        actions: ``[L, B, N, A]``.
    """
    x: Tensor = _FirstLayer.apply(weight, bias, observations, actions)  # type: ignore[no-untyped-call]
    return x


class _FirstLayer(torch.autograd.Function):
    """See :func:`first_layer_over_actions`.

    PyTorch's own gradient of the same lines would fill a tensor of the weights' size for each of
    their two parts and add them up, and copy the whole activation once more for being written to
    in place through a view.
    """

    @staticmethod
    def forward(
        ctx: Any, weight: Tensor, bias: Tensor, observations: Tensor, actions: Tensor
    ) -> Tensor:
        width, several = observations.shape[-1], actions.shape[2] > 1
        x = torch.baddbmm(bias, observations, weight[:, :width])
        if several:
            seen, x = x, torch.bmm(actions.flatten(1, 2), weight[:, width:])
            x.view(*actions.shape[:3], -1).add_(seen[:, :, None])
        else:
            x.baddbmm_(actions.squeeze(2), weight[:, width:])
        ctx.save_for_backward(weight, observations, actions)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        weight, observations, actions = ctx.saved_tensors
        of_weight, of_bias, of_observations, of_actions = ctx.needs_input_grad
        width, by_action = observations.shape[-1], gradient.reshape(*actions.shape[:3], -1)
        gradient = by_action.flatten(1, 2)
        of_state = by_action.squeeze(2) if actions.shape[2] == 1 else by_action.sum(dim=2)
        for_weight = for_bias = for_observations = for_actions = None
        if of_weight:
            for_weight = torch.empty_like(weight)
            torch.bmm(observations.mT, of_state, out=for_weight[:, :width])
            torch.bmm(actions.flatten(1, 2).mT, gradient, out=for_weight[:, width:])
        if of_bias:
            for_bias = of_state.sum(dim=1, keepdim=True)
        if of_observations:
            for_observations = torch.bmm(of_state, weight[:, :width].mT)
        if of_actions:
            for_actions = torch.bmm(gradient, weight[:, width:].mT).view_as(actions)
        return for_weight, for_bias, for_observations, for_actions


def lanewise_mean(x: Tensor) -> Tensor:
    """Mean over everything but the lane axis: ``[L, ...] -> [L]``."""
    return x.flatten(start_dim=1).mean(dim=1)


def lane_groups(module: Module, lanes: int, groups: int) -> list[tuple[slice, Module]]:
    """The same stack in parts: consecutive lanes, their parameters sharing the stack's memory.

    On a CPU, a loss whose activations of all lanes together overflow the cache is computed faster
    part by part. An update of the parts' parameters is an update of the stack's.

    Args:
        module: A stack; every parameter's first axis is a multiple of ``lanes``.
        lanes: L.
        groups: Largest number of parts; all of them but the last are of equal size.

    Returns:
        Lanes and stack of every part; a single part is the stack itself.
    """
    if min(groups, lanes) == 1:
        return [(slice(0, lanes), module)]
    parts = []
    for lanes_of_part in torch.arange(lanes).chunk(groups):
        first, last = int(lanes_of_part[0]), int(lanes_of_part[-1]) + 1
        part = copy.deepcopy(module)
        for whole, own in zip(module.parameters(), part.parameters(), strict=True):
            copies = whole.shape[0] // lanes
            own.data = whole.data[first * copies : last * copies]
        parts.append((slice(first, last), part))
    return parts


@torch.no_grad()
def polyak_update(pairs: Sequence[tuple[nn.Module, nn.Module]], rate: float) -> None:
    """Move parameters of targets by ``target <- rate * online + (1 - rate) * target``.

    Args:
        pairs: Target and online networks; all of them move in one operation.
        rate: tau.
    """
    targets, online = (
        [parameter for module in modules for parameter in module.parameters()]
        for modules in zip(*pairs, strict=True)
    )
    torch._foreach_lerp_(targets, online, rate)


def select_lanes(state: Mapping[str, Tensor], lanes: Sequence[int], of: int) -> dict[str, Tensor]:
    """Pick lanes out of the state of a stack.

    Args:
        state: Tensors whose first axis is ``of`` lanes, or ``of * m`` for networks with m copies a
            lane (twin critics, ensemble members), lane-major.
        lanes: Which lanes to keep, in the order wanted.
        of: Number of lanes in ``state``.

    Returns:
        The same names with ``len(lanes)`` lanes.

    Raises:
        ValueError: If a tensor's first axis is no multiple of ``of``.
    """
    picked = {}
    for name, tensor in state.items():
        if tensor.ndim == 0 or tensor.shape[0] % of:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, which holds no {of} lanes.")
        grouped = tensor.reshape(of, tensor.shape[0] // of, *tensor.shape[1:])
        index = torch.tensor(list(lanes), dtype=torch.long, device=tensor.device)
        picked[name] = grouped.index_select(0, index).flatten(0, 1)
    return picked
