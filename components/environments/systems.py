"""The registry of real systems, with all that is looked up by name or Gymnasium id.

Robots are registered by their specifications (:data:`.mujoco.specifications.ROBOTS`), other systems
by a record here.
"""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from components.environments.industrial.benchmark import DYNAMICS, IndustrialBenchmark
from components.environments.mujoco.specifications import ROBOTS, Robot, simulation_of
from components.environments.world import plane

__all__ = [
    "INDUSTRIAL_BENCHMARK",
    "SYSTEMS",
    "WORLD",
    "BatchEnvironment",
    "System",
    "check_simulator",
    "drawable_systems",
    "make_batch",
]


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
        """`[N]` whether the state after the last step is terminal, e.g. a fall."""

    def reset(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Start all copies; returns the first frames `[N, F]`."""

    def reset_copies(
        self, copies: NDArray[np.bool_], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Start the masked copies `[N]` again; returns their first frames `[copies.sum(), F]`."""

    def step(self, actions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Act with `[N, A]`; returns frames `[N, F]` and rewards `[N]`."""


@dataclass(frozen=True, kw_only=True)
class System:
    """One real system.

    Attributes:
        name: short name.
        id: Gymnasium id.
        batch: `batch(copies, threads=..., **parameters)` makes N copies stepped together; it
            imports the simulator when it is called.
        parameters: names of its parameters.
        dynamics: its dynamics specification, as on a dataset's card
            (:mod:`components.data.dynamics`).
        entry_point: "package.module:Class" of a single one, for Gymnasium.
        vector_entry_point: the same of Gymnasium's vectorised interface, if it has one.
        drawable: whether it can be drawn.
        simulator: tells what is installed that decides its numbers, e.g. "mujoco 3.5.0" and the
            model that it simulates; empty for a system that is part of this package.
    """

    name: str
    id: str
    batch: Callable[..., BatchEnvironment]
    parameters: tuple[str, ...]
    dynamics: Mapping[str, Any]
    entry_point: str
    vector_entry_point: str | None = None
    drawable: bool = False
    simulator: Callable[[], str] = lambda: ""


def _industrial(copies: int, *, threads: int, **parameters: Any) -> BatchEnvironment:
    return IndustrialBenchmark(copies, threads=threads, **parameters)


INDUSTRIAL_BENCHMARK: Final = System(
    name="industrial_benchmark",
    id="proximity/IndustrialBenchmark-v0",
    batch=_industrial,
    parameters=("setpoint",),
    dynamics=DYNAMICS,
    entry_point="components.environments.industrial.gymnasium_api:IndustrialBenchmarkEnv",
    vector_entry_point=(
        "components.environments.industrial.gymnasium_api:IndustrialBenchmarkVectorEnv"
    ),
)


def _agents(copies: int, *, threads: int) -> BatchEnvironment:
    return plane.Plane(copies, threads=threads)


WORLD: Final = System(
    name="world",
    id="proximity/World-v0",
    batch=_agents,
    parameters=(),
    dynamics=plane.DYNAMICS,
    entry_point="components.environments.world.gymnasium_api:WorldEnv",
    vector_entry_point="components.environments.world.gymnasium_api:WorldVectorEnv",
)


def _robot_system(robot: Robot) -> System:
    def batch(copies: int, *, threads: int, **parameters: Any) -> BatchEnvironment:
        from components.environments.mujoco.robots import Robots  # MuJoCo is slow to import

        return Robots(robot, copies, threads=threads, **parameters)

    return System(
        name=robot.name,
        id=robot.id,
        batch=batch,
        parameters=("physics",),
        dynamics=robot.dynamics,
        entry_point=f"components.environments.mujoco.gymnasium_api:{robot.class_name}",
        drawable=True,
        simulator=partial(simulation_of, robot),
    )


SYSTEMS: Final[Mapping[str, System]] = MappingProxyType(
    {
        system.id: system
        for system in (INDUSTRIAL_BENCHMARK, WORLD, *map(_robot_system, ROBOTS.values()))
    }
)
"""All systems by Gymnasium id."""


def drawable_systems() -> tuple[str, ...]:
    """Gymnasium ids of the systems that can be drawn."""
    return tuple(system.id for system in SYSTEMS.values() if system.drawable)


def check_simulator(environment: str, planned: str) -> None:
    """Refuse to simulate a system by another simulator than the planned one.

    Args:
        environment: Gymnasium id of the system.
        planned: what its record told where the work was planned.

    Raises:
        ValueError: another version is installed here.
    """
    found = SYSTEMS[environment].simulator()
    if found != planned:
        raise ValueError(
            f"{environment} was planned with {planned or 'no simulator'}, but {platform.node()} "
            f"has {found or 'none'}; install the same on all computers, as numbers of different "
            "versions differ."
        )


def make_batch(
    environment: str, copies: int, threads: int = 1, **parameters: Any
) -> BatchEnvironment:
    """N copies of the system with this Gymnasium id.

    Args:
        environment: the id.
        copies: N.
        threads: number of threads that step the copies; the numbers do not depend on it.
        parameters: of the system: `setpoint` of the Industrial Benchmark, `physics` of a robot;
            the 2-D world has none.

    Raises:
        ValueError: an unknown id or parameter.
    """
    if environment not in SYSTEMS:
        raise ValueError(f"Unknown environment {environment!r}; known are {', '.join(SYSTEMS)}.")
    system = SYSTEMS[environment]
    for name in parameters:
        if name not in system.parameters:
            raise ValueError(
                f"{environment} has no parameter {name!r}; it has "
                f"{', '.join(system.parameters) or 'none'}."
            )
    return system.batch(copies, threads=threads, **parameters)
