"""Copies of a real system stepped together: what collection and evaluation need of one."""

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from components.environments import HOPPER_ID, INDUSTRIAL_BENCHMARK_ID, SWIMMER_ID, WALKER2D_ID
from components.environments.industrial.benchmark import IndustrialBenchmark
from components.environments.mujoco.robots import Robots
from components.environments.mujoco.specifications import HOPPER, SWIMMER, WALKER2D

__all__ = ["BatchEnvironment", "make_batch"]


class BatchEnvironment(Protocol):
    """N copies of one system."""

    @property
    def frame_features(self) -> tuple[str, ...]:
        """Names of the F values of a frame."""

    @property
    def action_features(self) -> tuple[str, ...]:
        """Names of the A values of an action, each in [-1, 1]."""

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """`[N]` whose state after the last step is an end, such as a fall."""

    def reset(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Start all copies; returns the first frames `[N, F]`."""

    def reset_copies(
        self, copies: NDArray[np.bool_], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Start the masked copies `[N]` again; returns their first frames `[copies.sum(), F]`."""

    def step(self, actions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Act with `[N, A]`; returns frames `[N, F]` and rewards `[N]`."""


def _industrial(copies: int, *, threads: int, **parameters: Any) -> BatchEnvironment:
    """Whatever threads there are: its arithmetic is NumPy's."""
    return IndustrialBenchmark(copies, **parameters)


_MAKERS: Final[Mapping[str, Callable[..., BatchEnvironment]]] = MappingProxyType(
    {
        INDUSTRIAL_BENCHMARK_ID: _industrial,
        SWIMMER_ID: partial(Robots, SWIMMER),
        HOPPER_ID: partial(Robots, HOPPER),
        WALKER2D_ID: partial(Robots, WALKER2D),
    }
)


def make_batch(
    environment: str, copies: int, threads: int = 1, **parameters: Any
) -> BatchEnvironment:
    """N copies of the system with this Gymnasium id.

    Args:
        environment: the id.
        copies: N.
        threads: that step the copies; the numbers do not depend on it.
        parameters: of the system: `setpoint` of the Industrial Benchmark, `physics` of a robot.

    Raises:
        ValueError: If the id is unknown.
    """
    try:
        maker = _MAKERS[environment]
    except KeyError:
        raise ValueError(
            f"Unknown environment {environment!r}; known are {', '.join(_MAKERS)}."
        ) from None
    return maker(copies, threads=threads, **parameters)
