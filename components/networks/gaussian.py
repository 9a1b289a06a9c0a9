"""Stochastic policies: a diagonal Gaussian squashed by tanh, on stacked lanes.

``a = tanh(u)``, ``u ~ N(mean(s), std(s)^2)``; the density of ``a`` is that of ``u`` divided by the
derivative of tanh, in the form that neither overflows nor loses digits for large ``u``:
``log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u))``.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import hardtanh, softplus

from components.core.random_streams import spawn_generators
from components.networks.stacked import StackedMLP

__all__ = ["LOG_STD_RANGE", "Sample", "TanhGaussian", "log_density", "raw_actions"]

Sample = tuple[Tensor, Tensor, Tensor]
"""Actions, their values before the tanh, ``[L, B, N, A]`` each, and log densities ``[L, B, N]``."""

LOG_STD_RANGE = (-5.0, 2.0)
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def raw_actions(actions: Tensor, margin: float) -> Tensor:
    """Inverse tanh of actions, after a clip that keeps it finite.

    Logged actions often sit exactly on a bound, where the inverse is infinite.

    Args:
        actions: ``[...]`` in [-1, 1].
        margin: Clip to [-1 + margin, 1 - margin].
    """
    return torch.atanh(hardtanh(actions, -1.0 + margin, 1.0 - margin))


def log_density(mean: Tensor, log_std: Tensor, raw: Tensor) -> Tensor:
    """Log density of ``tanh(raw)`` under the squashed Gaussian, summed over the last axis."""
    return _density((raw - mean) * torch.exp(-log_std), log_std, raw)


def _density(standardised: Tensor, log_std: Tensor, raw: Tensor) -> Tensor:
    """The same from ``(raw - mean) / std``, in few operations and with constants added last."""
    # softplus with beta = -2 is -softplus(-2 u) / 2, so this is half the sum of what depends on u
    half = torch.sub(raw, softplus(raw, beta=-2.0), alpha=2.0)
    half = torch.sub(half, log_std, alpha=0.5)
    half = torch.addcmul(half, standardised, standardised, value=-0.25)
    return 2.0 * half.sum(dim=-1) - raw.shape[-1] * (_HALF_LOG_TWO_PI + 2.0 * math.log(2.0))


class TanhGaussian(nn.Module):
    """L squashed Gaussian policies side by side.

    Args:
        keys: One random stream per lane.
        purpose: Names the initial weights' stream.
        sizes: Observation width, hidden widths, action width.
        log_std_range: Bounds of the log standard deviation.
        squash: Reach the bounds smoothly by tanh (BRAC) instead of clamping (SAC, CQL, BEAR).
    """

    def __init__(
        self,
        keys: Sequence[int],
        purpose: str,
        sizes: Sequence[int],
        log_std_range: tuple[float, float] = LOG_STD_RANGE,
        squash: bool = False,
    ) -> None:
        super().__init__()
        self.low, self.high = log_std_range
        self.squash = squash
        self.stack = StackedMLP(spawn_generators(keys, purpose), (*sizes[:-1], 2 * sizes[-1]))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Mean before the tanh and log standard deviation, ``[L, B, A]`` each."""
        mean, spread = self.stack(observations).chunk(2, dim=-1)
        if self.squash:
            middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)
            return mean, half * torch.tanh(spread) + middle
        # clamps; its gradient, 0 on the bounds as beyond them, is one operation instead of five
        return mean, hardtanh(spread, self.low, self.high)

    @staticmethod
    def sample(parameters: tuple[Tensor, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
        """Sample by the reparameterisation ``u = mean + std * noise``.

        Args:
            parameters: What the forward pass returned.
            noise: Standard normal ``[L, B, N, A]``, N actions per observation.

        Returns:
            Actions and their values before the tanh.
        """
        mean, log_std = (p[:, :, None] for p in parameters)
        raw = torch.addcmul(mean, log_std.exp(), noise)
        return torch.tanh(raw), raw

    @classmethod
    def draw(cls, parameters: tuple[Tensor, Tensor], noise: Tensor) -> Sample:
        """Sample likewise, with log densities.

        The noise is the standardised value, so the density of a sample depends on its parameters
        through their deviation and the tanh alone.
        """
        actions, raw = cls.sample(parameters, noise)
        return actions, raw, _density(noise, parameters[1][:, :, None], raw)

    def mean_network(self) -> list[tuple[Tensor, Tensor]]:
        """The layers that compute the mean: the last one without its second half."""
        *hidden, (weight, bias) = self.stack.affine()
        width = weight.shape[-1] // 2
        return [*hidden, (weight[..., :width], bias[..., :width])]
