"""Networks and densities once more, in plain double precision: what the learners' tests compare to.

Nothing here calls the code under test; weights alone are read from it.
"""

import math
from collections.abc import Callable

import numpy as np
from torch import Tensor

from components.networks import StackedMLP

__all__ = [
    "critic",
    "discrepancy_by_loops",
    "floats",
    "gaussian_parameters",
    "network",
    "slopes",
    "squashed_log_density",
    "unsquashed_log_density",
]

Array = np.ndarray


def floats(tensor: Tensor) -> Array:
    """Numbers of a tensor as float64."""
    return tensor.detach().double().numpy()


def network(stack: StackedMLP, lane: int, x: Array) -> Array:
    """One copy of a stack with ReLU between its layers, on rows ``[B, in]``."""
    layers = [(floats(weight)[lane], floats(bias)[lane]) for weight, bias in stack.affine()]
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight + bias, 0.0)
    weight, bias = layers[-1]
    return x @ weight + bias


def critic(stack: StackedMLP, number: int, observation: Array, action: Array) -> float:
    """Value of one pair under the stack's copy ``number`` (2 L + j for critic j of lane L)."""
    return float(network(stack, number, np.concatenate([observation, action])[None])[0, 0])


def gaussian_parameters(stack: StackedMLP, lane: int, observation: Array) -> tuple[Array, Array]:
    """The two halves of a Gaussian policy's output at one observation."""
    out = network(stack, lane, observation[None])[0]
    return out[: len(out) // 2], out[len(out) // 2 :]


def unsquashed_log_density(mean: Array, std: Array, raw: Array) -> float:
    """log N(raw; mean, std^2) - log(1 - tanh(raw)^2), entry by entry; 1 - tanh^2 = 1 / cosh^2."""
    total = 0.0
    for m, s, u in zip(mean, std, raw, strict=True):
        total += -0.5 * ((u - m) / s) ** 2 - math.log(s * math.sqrt(2.0 * math.pi))
        total += 2.0 * math.log(math.cosh(u))
    return total


def squashed_log_density(mean: Array, std: Array, action: Array, margin: float) -> float:
    """The same at an action, after a clip to [-1 + margin, 1 - margin]."""
    clipped = [min(max(float(a), -1.0 + margin), 1.0 - margin) for a in action]
    return unsquashed_log_density(mean, std, np.array([math.atanh(a) for a in clipped]))


def slopes(loss: Callable[[], float], numbers: Tensor) -> list[float]:
    """Central differences of a loss in every one of some double numbers."""
    found, step = [], 1e-6
    for n in range(len(numbers)):
        sides = []
        for shift in (step, -2.0 * step):
            numbers[n] += shift
            sides.append(loss())
        numbers[n] += step
        found.append((sides[0] - sides[1]) / (2.0 * step))
    return found


def discrepancy_by_loops(x: Array, y: Array, kernel: str, sigma: float) -> float:
    """Of two samples ``[N, A]`` and ``[M, A]`` at one state."""

    def mean_kernel(u: Array, v: Array) -> float:
        total = 0.0
        for a in u:
            for b in v:  # every pair, also of a point with itself
                apart = 0.0
                for p, q in zip(a, b, strict=True):
                    apart += abs(p - q) if kernel == "laplacian" else (p - q) ** 2
                total += math.exp(-apart / (2.0 * sigma))
        return total / (len(u) * len(v))

    return math.sqrt(mean_kernel(x, x) + mean_kernel(y, y) - 2.0 * mean_kernel(x, y) + 1e-6)
