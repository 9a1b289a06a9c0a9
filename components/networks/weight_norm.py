"""Weight normalisation on stacked lanes: directions and lengths of weights learned separately.

The weights of a unit are ``w = g v / |v|`` (Salimans and Kingma 2016; thesis 3.37). At the start
``g = |v|``, so that the function is that of the plain stack drawn from the same generators.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from components.networks.stacked import Activation, StackedLinear

__all__ = ["WeightNormMLP"]


class WeightNormMLP(nn.Module):
    """L multilayer perceptrons side by side, every unit's weights normalised.

    Args:
        generators: One generator per lane, consumed for the initial weights.
        sizes: Layer widths from input to output.
        activation: Applied after every hidden layer, in place if it can; the output is linear.
    """

    def __init__(
        self,
        generators: Sequence[np.random.Generator],
        sizes: Sequence[int],
        activation: Activation = torch.relu_,
    ) -> None:
        super().__init__()
        plain = [StackedLinear(generators, inputs, outputs) for inputs, outputs in pairwise(sizes)]
        self.directions = nn.ParameterList([layer.weight for layer in plain])
        self.lengths = nn.ParameterList([_norm(layer.weight.detach()) for layer in plain])
        self.biases = nn.ParameterList([layer.bias for layer in plain])
        self._activation = activation

    def affine(self) -> list[tuple[Tensor, Tensor]]:
        """Plain weight ``[L, in, out]`` and bias ``[L, 1, out]`` of every layer."""
        parts = zip(self.directions, self.lengths, self.biases, strict=True)
        return [(v * (g / _norm(v)), bias) for v, g, bias in parts]

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[L, B, in]`` to ``[L, B, out]``."""
        *hidden, (weight, bias) = self.affine()
        for inner_weight, inner_bias in hidden:
            x = self._activation(torch.baddbmm(inner_bias, x, inner_weight))
        return torch.baddbmm(bias, x, weight)


def _norm(weight: Tensor) -> Tensor:
    """Length ``[L, 1, out]`` of every unit's weights."""
    return weight.square().sum(dim=1, keepdim=True).sqrt()
