"""What a stream draws at every step: rules that make numbers of random words.

A rule says how many 64-bit words a step of a lane takes, and makes its numbers of them by the same
operations on every device. Integers are equal everywhere, bit for bit; real numbers are equal but
for the last digits of a device's elementary functions.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

__all__ = ["Beta", "Choice", "Draw", "Integers", "Normal", "Order", "Uniform", "UniformDouble"]

_KNOTS: Final = 1 << 15


class Draw(nn.Module):
    """A drawing rule; a module, so that its tables follow it to a device.

    Called with ``words``, int64 ``[T, L, words]`` of T steps of L lanes, it returns numbers
    ``[T, L, *shape]``.

    Args:
        shape: Of the numbers of a step of a lane.
        bits: Random bits a number, 32 or 64.

    Attributes:
        words: 64-bit words that a step of a lane takes.
    """

    def __init__(self, shape: tuple[int, ...], bits: int) -> None:
        super().__init__()
        self._shape = shape
        self.words = -(-math.prod(shape) * bits // 64)

    def _shaped(self, flat: Tensor) -> Tensor:
        """The first numbers of ``flat [T, L, n]``; 32-bit rules may have made one too many."""
        return flat[..., : math.prod(self._shape)].reshape(*flat.shape[:2], *self._shape)


def _fractions(words: Tensor) -> Tensor:
    """Float32 ``[..., 2 n]`` in [0, 1) of ``words [..., n]``: the upper 24 bits of every half."""
    return ((words.view(torch.int32) >> 8) & 0xFFFFFF) * 2.0**-24


def _doubles(words: Tensor) -> Tensor:
    """Float64 in [0, 1) of words: their upper 53 bits."""
    return ((words >> 11) & ((1 << 53) - 1)).double() * 2.0**-53


class Normal(Draw):
    """Standard normal numbers, float32, by the method of Box and Muller.

    With 24 bits for the radius none is beyond 5.77 standard deviations, as 8 of a billion would be.

    Args:
        shape: Of the numbers of a step of a lane.
    """

    def __init__(self, *shape: int) -> None:
        super().__init__(shape, 32)

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        fractions = _fractions(words)
        radius = fractions[..., : self.words] + 2.0**-24  # (0, 1]
        radius = radius.log_().mul_(-2.0).sqrt_()
        angle = fractions[..., self.words :] * (2.0 * math.pi)
        return self._shaped(torch.cat([radius * angle.cos(), radius * angle.sin_()], dim=-1))


class Uniform(Draw):
    """Uniform numbers in [low, high), float32 with 24 random bits.

    Args:
        shape: Of the numbers of a step of a lane.
        low: Least number.
        high: Bound above.
    """

    def __init__(self, *shape: int, low: float = 0.0, high: float = 1.0) -> None:
        super().__init__(shape, 32)
        self._low, self._width = low, high - low

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        return self._shaped(_fractions(words).mul_(self._width).add_(self._low))


class UniformDouble(Draw):
    """Uniform numbers in [0, 1), float64: fine enough to choose among millions of places.

    Args:
        shape: Of the numbers of a step of a lane.
    """

    def __init__(self, *shape: int) -> None:
        super().__init__(shape, 64)

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        return self._shaped(_doubles(words))


class Integers(Draw):
    """Integers from 0 to a lane's limit, excluded, int64.

    The upper half of the product of 32 random bits and the limit: the chances of two integers
    differ by at most a share of ``limit / 2**32``.

    Args:
        limits: One per lane.
        shape: Of the numbers of a step of a lane.

    Raises:
        ValueError: If a limit is not in [1, 2**31).
    """

    _limits: Tensor

    def __init__(self, limits: Sequence[int], *shape: int) -> None:
        super().__init__(shape, 32)
        if not all(0 < limit < 1 << 31 for limit in limits):
            raise ValueError(f"Limits of integers must lie in [1, 2**31), got {list(limits)}.")
        self.register_buffer("_limits", torch.tensor(limits, dtype=torch.int64)[:, None])

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        halves = words.view(torch.int32).long() & 0xFFFFFFFF
        return self._shaped((halves * self._limits) >> 32)


class Choice(Draw):
    """Values of a lane's own list, with replacement, int64.

    Args:
        values: One list ``[n]`` per lane; they may differ in length.
        shape: Of the numbers of a step of a lane.
    """

    _values: Tensor
    _offsets: Tensor

    def __init__(self, values: Sequence[npt.NDArray[np.int64]], *shape: int) -> None:
        super().__init__(shape, 32)
        lengths = [len(own) for own in values]
        self._places = Integers(lengths, math.prod(shape))
        self.register_buffer("_values", torch.from_numpy(np.concatenate([*values])))
        offsets = torch.tensor(lengths).cumsum(0) - torch.tensor(lengths)
        self.register_buffer("_offsets", offsets[:, None])

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        return self._shaped(self._values[self._places(words) + self._offsets])


class Order(Draw):
    """A permutation of 0 ... n - 1, int64: the order of n random words.

    Args:
        count: n.
    """

    def __init__(self, count: int) -> None:
        super().__init__((count,), 64)

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, n]``."""
        return words.argsort(dim=-1, stable=True)


class Beta(Draw):
    """Numbers of the symmetric Beta(b, b) distribution, float32, by its quantile function.

    With x = sin(angle)^2 the density of the angle is proportional to sin(2 angle)^(2 b - 1). Its
    quantiles are interpolated between 32,768 equally spaced angles.

    Args:
        parameter: b.
        shape: Of the numbers of a step of a lane.
    """

    _below: Tensor

    def __init__(self, parameter: float, *shape: int) -> None:
        from scipy.special import betainc  # slow to import, and few learners need it

        super().__init__(shape, 64)
        self._width = math.pi / 2.0 / _KNOTS
        quantiles = np.sin(self._width * np.arange(_KNOTS + 1)) ** 2
        below = torch.from_numpy(betainc(parameter, parameter, quantiles.clip(0.0, 1.0)))
        self.register_buffer("_below", below)

    def forward(self, words: Tensor) -> Tensor:
        """Numbers ``[T, L, *shape]``."""
        share = _doubles(words)
        right = torch.searchsorted(self._below, share, right=True).clamp_(1, _KNOTS)
        low, high = self._below[right - 1], self._below[right]
        angle = self._width * (right - 1 + (share - low) / (high - low))
        return self._shaped(angle.sin_().square_().float())
