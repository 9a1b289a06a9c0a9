"""The three controllers that logged the Industrial Benchmark datasets, and their exploration.

Source: thesis section 3.1.1 (the three baselines and equation 3.28). The scales of the optimised
controller, which the thesis leaves out, are the statistics of the data on which its formula was
found, not of any dataset made with it. `bad` and `mediocre` act on unscaled steerings. A lag counts
back from the current frame, which has lag 0.

Histories are `[N, L, 6]`, newest first, in the units of the machine; actions are `[N, 3]` in
[-1, 1] (velocity, gain, shift).
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["CONTROLLERS", "Controller", "bad", "epsilon_greedy", "mediocre", "optimized"]

Array = NDArray[np.float64]
Controller = Callable[[Array], Array]

_SETPOINT, _VELOCITY, _SHIFT, _FATIGUE = 0, 1, 3, 4
_STEERINGS = slice(1, 4)
_MEANS: Final = (55.0, 48.75, 50.53, 49.45, 37.51, 166.33)
_DEVIATIONS: Final = (28.72, 12.31, 29.91, 29.22, 31.17, 139.44)


def bad(history: Array) -> Array:
    """Move all steerings towards 100, where the machine's rewards are lowest."""
    return np.clip(100.0 - history[:, 0, _STEERINGS], -1.0, 1.0)


def mediocre(history: Array) -> Array:
    """Move all steerings towards 25; gain and shift overshoot and oscillate around it."""
    return np.clip(25.0 - history[:, 0, _STEERINGS], -1.0, 1.0)


def optimized(history: Array) -> Array:
    """The formula found by genetic programming for reinforcement learning.

    Needs at least six frames of history.
    """

    def scaled(feature: int, lag: int) -> Array:
        return (history[:, lag, feature] - _MEANS[feature]) / _DEVIATIONS[feature]

    setpoint = scaled(_SETPOINT, 0)
    actions = np.stack(
        [
            -scaled(_VELOCITY, 5) - 0.91,
            2.0 * scaled(_FATIGUE, 3) - setpoint + 1.43,
            -3.48 * scaled(_SHIFT, 3) - scaled(_SHIFT, 4) + 2.0 * setpoint + 0.81,
        ],
        axis=1,
    )
    return np.clip(actions, -1.0, 1.0)


CONTROLLERS: Final[Mapping[str, Controller]] = MappingProxyType(
    {"bad": bad, "mediocre": mediocre, "optimized": optimized}
)
"""The controllers by the name that datasets use."""


def epsilon_greedy(actions: Array, epsilon: float, rng: np.random.Generator) -> Array:
    """Replace whole action vectors by uniform ones (equation 3.28).

    Args:
        actions: `[N, 3]` of the controller.
        epsilon: probability of each row to be replaced, 0 ... 1.
        rng: generator, from which 4 N numbers are drawn whatever epsilon is.

    Returns:
        `[N, 3]`, a new array.
    """
    explore = rng.random(len(actions)) < epsilon
    random = rng.uniform(-1.0, 1.0, actions.shape)
    return np.where(explore[:, None], random, actions)
