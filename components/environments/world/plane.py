"""Agents in a plane, rewarded by their distance to a fixed point (thesis 6.5).

An action is a step of at most 1 along each coordinate; the next position is the sum of the two and
is not clipped, so agents may leave the square in which they start. The reward is a Gaussian of the
new position around (3, 6), of width 1.5, scaled to a maximum of 1 as in the authors' data (the
thesis prints the factor of a density). There is neither noise nor an end.

Shapes: positions and actions `[N, 2]`, rewards `[N]`.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "CENTRE",
    "COORDINATES",
    "DYNAMICS",
    "SIDE",
    "STEPS",
    "Plane",
    "reward_at",
]

COORDINATES: Final = ("x", "y")
"""Names of the values of a frame."""
STEPS: Final = ("step_x", "step_y")
"""Names of the values of an action."""
SIDE: Final = 10.0
"""Agents start uniformly in the square [0, SIDE]^2."""
CENTRE: Final = (3.0, 6.0)
"""Where the reward is greatest, 1."""
_WIDTH: Final = 1.5  # sigma of the reward

DYNAMICS: Final[Mapping[str, Any]] = {
    "known": {
        "features": list(STEPS),
        "keep": [0.0] * len(STEPS),
        "scale": [1.0] * len(STEPS),
        "low": -1.0,
        "high": 1.0,
    },
    "learned": [*COORDINATES, "reward"],
    "reward": {"reward": 1.0},
}
"""The dynamics specification: nothing is known without learning but the action itself, so that
models have to learn how agents move, as in the thesis."""

Array = NDArray[np.float64]


def reward_at(positions: ArrayLike) -> Array:
    """Reward `[...]` of positions `[..., 2]`: exp(-0.5 ((x - 3)^2 + (y - 6)^2) / 1.5^2)."""
    distance = (np.asarray(positions, dtype=np.float64) - CENTRE) / _WIDTH
    rewards: Array = np.exp(-0.5 * np.square(distance).sum(axis=-1))
    return rewards


class Plane:
    """N agents.

    Args:
        copies: N.
        threads: taken and not used; a step takes no time.

    Attributes:
        frame_features: `COORDINATES`.
        action_features: `STEPS`.
        terminated: `[N]` all false: nothing ends here.

    Raises:
        ValueError: a copy or thread count below one.
    """

    def __init__(self, copies: int, threads: int = 1) -> None:
        if copies < 1 or threads < 1:
            raise ValueError(f"copies is {copies} and threads is {threads}; give at least 1.")
        self.copies = copies
        self.frame_features = COORDINATES
        self.action_features = STEPS
        self.terminated = np.zeros(copies, dtype=np.bool_)
        self._positions: Array | None = None

    def reset(
        self, rng: np.random.Generator, *, start: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Put all agents somewhere.

        Args:
            rng: generator of their positions, uniform in the square.
            start: `x` or `y` to be set instead, one number for all agents or one for each.

        Returns:
            `[N, 2]` their positions.

        Raises:
            ValueError: an unknown coordinate, or a value that is no finite number.
        """
        self._positions = _starts(self.copies, rng, start)
        return self._positions.copy()

    def reset_copies(
        self,
        copies: NDArray[np.bool_],
        rng: np.random.Generator,
        *,
        start: Mapping[str, ArrayLike] | None = None,
    ) -> Array:
        """Put some of the agents somewhere else while the others stay where they are.

        Args:
            copies: `[N]` mask of them.
            rng: as in `reset`.
            start: as in `reset`, arrays as long as the mask has true entries.

        Returns:
            `[copies.sum(), 2]` their positions.
        """
        positions = self._running()
        fresh = _starts(int(copies.sum()), rng, start)
        positions[copies] = fresh
        return fresh

    def step(self, actions: ArrayLike) -> tuple[Array, Array]:
        """Move every agent.

        Args:
            actions: `[N, 2]` steps, clipped to [-1, 1].

        Returns:
            The new positions `[N, 2]` and the rewards `[N]` there.

        Raises:
            ValueError: a wrong shape, a value that is not a number, or no reset before.
        """
        wanted = np.asarray(actions, dtype=np.float64)
        if wanted.shape != (self.copies, len(STEPS)):
            raise ValueError(
                f"actions have the shape {wanted.shape}; {self.copies} copies need "
                f"({self.copies}, {len(STEPS)})."
            )
        if np.isnan(wanted).any():
            raise ValueError("actions hold a value that is not a number; the copies did not move.")
        self._positions = self._running() + np.clip(wanted, -1.0, 1.0)
        return self._positions.copy(), reward_at(self._positions)

    def _running(self) -> Array:
        if self._positions is None:
            raise ValueError("step was called before reset; reset the environment first.")
        return self._positions


def _starts(count: int, rng: np.random.Generator, start: Mapping[str, ArrayLike] | None) -> Array:
    """Positions `[count, 2]`, some coordinates of which may be given."""
    positions = rng.uniform(0.0, SIDE, (count, len(COORDINATES)))
    for name, value in (start or {}).items():
        if name not in COORDINATES:
            raise ValueError(f"unknown start value {name!r}; known are {', '.join(COORDINATES)}.")
        given = np.asarray(value, dtype=np.float64)
        if given.shape not in ((), (count,)) or not np.isfinite(given).all():
            raise ValueError(
                f"start value {name} must be a finite number, or one for each of {count} copies."
            )
        positions[:, COORDINATES.index(name)] = given
    return positions
