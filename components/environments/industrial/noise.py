"""The random draws of one Industrial Benchmark step, drawn or injected.

One step of N copies takes, in this order: an exponential, a uniform and a binary draw for each of
velocity and gain (thesis equations 3.24-3.27), a normal where the fatigue has saturated (equation
3.19) and a normal for the consumption (equation 3.8). `NoiseSource` is the interface. `DrawnNoise`
draws from a `numpy.random.Generator`; `Noise` holds given arrays, so that a recorded run can be
replayed or a test can fix every draw.
Arrays of velocity and gain are `[2, N]`, velocity first.

Deviations from the thesis, as the reference does it: the base noise is an exponential of mean 0.1
that the dynamics squashes (the thesis has a Bernoulli draw); the probability of the binary draw is
clipped to [0.001, 0.999].
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "EXPONENTIAL_MEAN",
    "DrawnNoise",
    "Later",
    "Noise",
    "NoiseSource",
    "saturate",
    "squash",
]

EXPONENTIAL_MEAN = 0.1
_PROBABILITY_FLOOR, _PROBABILITY_CEILING = 0.001, 0.999
_BLOCK_STEPS = 16

Array = NDArray[np.float64]
Later = Callable[..., "Future[None]"]
"""`later(work, *arguments)` has `work` done by another thread, as `Executor.submit` does."""


def squash(exponential: Array) -> Array:
    """Base noise of equations 3.24 and 3.25: 2 (logistic(x) - 1/2) of an exponential draw x."""
    squashed: Array = np.tanh(0.5 * exponential)
    return squashed


def saturate(normal: Array) -> Array:
    """Saturated fatigue (equation 3.19) of a standard normal draw x: logistic(2.4 + 0.4 x)."""
    saturated = 0.4 * normal
    np.subtract(-2.4, saturated, out=saturated)
    np.exp(saturated, out=saturated)
    saturated += 1.0
    np.divide(1.0, saturated, out=saturated)
    return saturated


class NoiseSource(Protocol):
    """Provides the draws of one step; its methods are called in the order below."""

    def fatigue(self, effective: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Squashed exponential (`squash`), uniform and binary draws, each `[2, N]`.

        Args:
            effective: `[2, N]` effective velocity and gain, the probabilities of the binary draws
                after clipping to [0.001, 0.999].
        """
        ...

    def saturation(self, saturated: NDArray[np.bool_]) -> Array:
        """Saturated fatigue `[N]` (`saturate`); only where `saturated` is true it is used."""
        ...

    def consumption(self) -> Array:
        """Standard normals `[N]`, added to the consumption times its standard deviation."""
        ...


@dataclass(frozen=True)
class Noise:
    """Given draws for one step of N copies; each field is `[N]`.

    Attributes:
        gain_exponential: exponential draw of mean 0.1 for the gain.
        velocity_exponential: the same for the velocity.
        gain_uniform: uniform draw in [0, 1) for the gain.
        velocity_uniform: the same for the velocity.
        gain_binary: outcome, 0 or 1, of the draw with the clipped effective gain as probability.
        velocity_binary: the same for the effective velocity.
        saturation_normal: standard normal of the saturated fatigue.
        consumption_normal: standard normal of the consumption.
    """

    gain_exponential: Array
    velocity_exponential: Array
    gain_uniform: Array
    velocity_uniform: Array
    gain_binary: Array
    velocity_binary: Array
    saturation_normal: Array
    consumption_normal: Array

    @classmethod
    def zeros(cls, copies: int) -> "Noise":
        """Every draw zero: the noise-free dynamics."""
        return cls(*(np.zeros(copies) for _ in range(8)))

    def fatigue(self, effective: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """See `NoiseSource.fatigue`."""
        return (
            squash(np.stack([self.velocity_exponential, self.gain_exponential])),
            np.stack([self.velocity_uniform, self.gain_uniform]),
            np.stack([self.velocity_binary, self.gain_binary]).astype(np.bool_),
        )

    def saturation(self, saturated: NDArray[np.bool_]) -> Array:
        """See `NoiseSource.saturation`."""
        return saturate(self.saturation_normal)

    def consumption(self) -> Array:
        """See `NoiseSource.consumption`."""
        return self.consumption_normal


class _Block:
    """The draws of `_BLOCK_STEPS` steps, in buffers that are filled again and again."""

    def __init__(self, copies: int) -> None:
        shape = (_BLOCK_STEPS, 2, copies)
        self.base, self.threshold, self.normal = (np.empty(shape) for _ in range(3))

    def fill(self, rng: np.random.Generator) -> None:
        """Draw all of it, a few long calls during which other threads run."""
        rng.standard_exponential(out=self.base)
        self.base *= 0.5 * EXPONENTIAL_MEAN
        np.tanh(self.base, out=self.base)
        rng.random(out=self.threshold)
        rng.standard_normal(out=self.normal)
        self.saturated = saturate(self.normal[:, 0])


class DrawnNoise:
    """Draws many steps at once, because one large call beats many small ones.

    Every copy receives its draws whether it needs them or not, so what one copy draws does not
    depend on the state of another. Uniform and binary draw come from a single uniform number t:
    given t < p, t / p is uniform again.

    Args:
        rng: generator from which the seed of a faster one is drawn; it is not used after that.
        copies: number of copies N.
        later: has the steps after the present ones drawn by another thread meanwhile, which changes
            none of them; None: they are drawn when they are needed.
    """

    def __init__(self, rng: np.random.Generator, copies: int, later: Later | None = None) -> None:
        seed = rng.integers(0, 2**32, size=4, dtype=np.uint32)
        self._rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed.tolist())))
        self._later = later
        self._filling: Future[None] | None = None
        self._block = _Block(copies)
        self._spare = self._block if later is None else _Block(copies)
        self._probability = np.empty((2, copies))
        self._floor = np.full((2, copies), _PROBABILITY_FLOOR)
        self._ceiling = np.full((2, copies), _PROBABILITY_CEILING)
        self._uniform = np.empty((2, copies))
        self._binary = np.empty((2, copies), dtype=np.bool_)
        self._next = _BLOCK_STEPS
        self._now = 0

    def _move_on(self) -> None:
        """Take the next block into use."""
        self._block, self._spare = self._spare, self._block
        if self._filling is None:
            self._block.fill(self._rng)
        else:
            self._filling.result()
        if self._later is not None:
            self._filling = self._later(self._spare.fill, self._rng)
        self._next = 0

    def fatigue(self, effective: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """See `NoiseSource.fatigue`; moves on to the next step."""
        if self._next == _BLOCK_STEPS:
            self._move_on()
        now = self._now = self._next
        self._next += 1
        threshold, probability = self._block.threshold[now], self._probability
        np.maximum(effective, self._floor, out=probability)
        np.minimum(probability, self._ceiling, out=probability)
        np.less(threshold, probability, out=self._binary)
        np.divide(threshold, probability, out=self._uniform)
        return self._block.base[now], self._uniform, self._binary

    def saturation(self, saturated: NDArray[np.bool_]) -> Array:
        """See `NoiseSource.saturation`."""
        fatigue: Array = self._block.saturated[self._now]
        return fatigue

    def consumption(self) -> Array:
        """See `NoiseSource.consumption`."""
        normals: Array = self._block.normal[self._now, 1]
        return normals
