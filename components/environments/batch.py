"""Copies of a real system stepped together: what collection and evaluation need of one."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.industrial_benchmark import IndustrialBenchmark

__all__ = ["BatchEnvironment", "make_batch"]


class BatchEnvironment(Protocol):
    """N copies of one system."""

    def reset(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Start all copies; returns the first frames `[N, F]`."""

    def step(self, actions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Act with `[N, A]`; returns frames `[N, F]` and rewards `[N]`."""


_MAKERS: Final[Mapping[str, Callable[..., BatchEnvironment]]] = MappingProxyType(
    {INDUSTRIAL_BENCHMARK_ID: IndustrialBenchmark}
)


def make_batch(environment: str, copies: int, **parameters: Any) -> BatchEnvironment:
    """N copies of the system with this Gymnasium id.

    Raises:
        ValueError: If the id is unknown.
    """
    try:
        maker = _MAKERS[environment]
    except KeyError:
        raise ValueError(
            f"Unknown environment {environment!r}; known are {', '.join(_MAKERS)}."
        ) from None
    return maker(copies, **parameters)
