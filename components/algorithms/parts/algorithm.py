"""The record by which plans, tasks and tests use an algorithm; every algorithm's module has one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from components.algorithms.parts.learner import LearnerInputs, PolicyLearner
from components.data.sizes import DataSizes, relative_work

__all__ = ["Algorithm", "PolicyConfig", "per_transition", "per_virtual_step"]


class PolicyConfig(Protocol):
    """Settings that all algorithms have."""

    @property
    def updates(self) -> int:
        """Budget, in updates."""


C = TypeVar("C", bound=PolicyConfig)


@dataclass(frozen=True, kw_only=True)
class Algorithm(Generic[C]):
    """An algorithm.

    Attributes:
        name: In configurations, random streams, plans and tables.
        config: Its settings with their defaults, a frozen dataclass.
        learner: ``learner(config, inputs)`` makes a new stack of learners.
        version: To be raised whenever a change of its code can change results; part of node keys.
        version_with_falls: The same for datasets whose systems can fall, where its code for falls
            alone has changed; None: there is no difference.
        cost: Core-seconds of one seed at given settings on data of given sizes, without what is
            the same for all budgets, measured roughly on a computer of 2026. Costs order the nodes,
            and estimate their time until times of finished nodes are known.
        needs: Fitted models that the learner is given, names in :data:`components.models.MODELS`.
        transitions: Models among which its setting `transition` chooses one, that of `needs`
            first; empty: there is no choice.
        takes_proximity: Whether the proximity is an input of its policies.
        frame_epsilon: Added to every feature's deviation when frames are scaled.
    """

    name: str
    config: type[C]
    learner: Callable[[C, LearnerInputs], PolicyLearner]
    version: int
    cost: Callable[[C, DataSizes], float]
    needs: tuple[str, ...] = ()
    transitions: tuple[str, ...] = ()
    takes_proximity: bool = False
    frame_epsilon: float = 0.0
    version_with_falls: int | None = None

    def models_for(self, config: C) -> tuple[str, ...]:
        """Names of the models that the learner is given with these settings."""
        if not self.transitions:
            return self.needs
        chosen: str = getattr(config, "transition")  # noqa: B009 - no setting of all algorithms
        return tuple(chosen if name in self.transitions else name for name in self.needs)

    def version_on(self, dynamics: Mapping[str, Any]) -> int:
        """The version that counts for a dataset, by the dynamics specification on its card."""
        own = self.version_with_falls if dynamics.get("healthy") else None
        return self.version if own is None else own


class _Batched(PolicyConfig, Protocol):
    @property
    def batch(self) -> int: ...


class _Virtual(PolicyConfig, Protocol):
    @property
    def trajectories(self) -> int: ...

    @property
    def horizon(self) -> int: ...


def per_transition(seconds: float) -> Callable[[_Batched, DataSizes], float]:
    """The cost of learners on batches.

    Args:
        seconds: Core-seconds for each transition of a batch, with the default networks on the
            Industrial Benchmark; with others :func:`.relative_work` times as many.
    """
    return lambda config, sizes: (
        seconds * float(config.updates * config.batch) * relative_work(config, sizes)
    )


def per_virtual_step(seconds: float) -> Callable[[_Virtual, DataSizes], float]:
    """The cost of learners on virtual trajectories.

    Args:
        seconds: As those of :func:`per_transition`, for each step of a virtual trajectory.
    """
    return lambda config, sizes: (
        seconds
        * float(config.updates * config.trajectories * config.horizon)
        * relative_work(config, sizes)
    )
