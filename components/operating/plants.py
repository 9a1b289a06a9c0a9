"""What is operated on: a real system in two copies, or the recorded states of a log.

Both copies begin in the same state and receive the same noise, so that they differ by what is done
to them alone.
"""

from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from components.core.random_streams import lane_generator, lane_key
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.environments.systems import SYSTEMS, BatchEnvironment, make_batch

__all__ = ["COPIES", "Plant", "Recorded", "Twins", "plant_of"]

COPIES: Final = 2
"""The operated copy and, second, the one that the behaviour operates."""

_SETPOINT: Final = "setpoint"

Array = NDArray[np.float64]


class Plant(Protocol):
    """Two copies in lock-step."""

    @property
    def real(self) -> bool:
        """Whether actions have an effect."""

    @property
    def horizon(self) -> int:
        """Steps of the present episode, at most."""

    @property
    def setpoint(self) -> float | None:
        """What is demanded of it; None where nothing can be."""

    def demand(self, setpoint: float) -> None:
        """Demand something else from now on."""

    def start(self, seed: int, episode: int) -> Array:
        """Begin an episode; returns frames `[2, F]`."""

    def logged(self) -> Array | None:
        """The action `[A]` that was logged in this state, where the state is a recorded one."""

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Act with `[2, A]`; returns frames `[2, F]`, rewards `[2]` and which copies have ended."""


class Twins:
    """A registered system, twice.

    Args:
        card: Of the log, which names the system.
    """

    real = True

    def __init__(self, card: DatasetCard) -> None:
        self._name, self._parameters = card.environment, dict(card.environment_parameters)
        self.horizon = card.steps
        self.setpoint: float | None = None
        if _SETPOINT in SYSTEMS[card.environment].parameters:
            self.setpoint = float(self._parameters.get(_SETPOINT, 70.0))
        self.systems = self._make()

    def demand(self, setpoint: float) -> None:
        """Demand another load, 0 to 100, from the next step on.

        Raises:
            ValueError: It is out of range, or the system takes none.
        """
        if self.setpoint is None:
            raise ValueError(f"{self._name} has no setpoint.")
        for system in self.systems:
            system.demand(setpoint)  # type: ignore[attr-defined]  # those that have a setpoint
        self.setpoint = float(setpoint)

    def start(self, seed: int, episode: int) -> Array:
        """Begin an episode, whose start and noise are a function of seed and episode alone."""
        if self.setpoint is not None:
            self._parameters[_SETPOINT] = self.setpoint
        self.systems = self._make()
        key = lane_key("operating", seed, episode)
        return np.concatenate([system.reset(lane_generator(key)) for system in self.systems])

    def logged(self) -> Array | None:
        """None: nothing is recorded of a running system."""
        return None

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """See :class:`Plant`."""
        moved = [system.step(own[None]) for system, own in zip(self.systems, actions, strict=True)]
        frames, rewards = (np.concatenate(own) for own in zip(*moved, strict=True))
        return frames, rewards, np.concatenate([system.terminated for system in self.systems])

    def _make(self) -> list[BatchEnvironment]:
        parameters: dict[str, Any] = self._parameters
        return [make_batch(self._name, 1, **parameters) for _ in range(COPIES)]


class Recorded:
    """Episodes of a log, in which actions are shown and have no effect.

    Args:
        log: The log.
    """

    real = False
    setpoint = None

    def __init__(self, log: OfflineDataset) -> None:
        self._log = log
        self.horizon, self._step, self._frame = log.card.steps, 0, 0

    def demand(self, setpoint: float) -> None:
        """Refuse: what is recorded does not change.

        Raises:
            ValueError: Always.
        """
        raise ValueError("Recorded states have no setpoint to be changed.")

    def start(self, seed: int, episode: int) -> Array:
        """Go to an episode of the log: the first, the second and so on, whatever the seed."""
        chosen = episode % self._log.episodes
        first, last = (int(n) for n in self._log.episode_starts[chosen : chosen + 2])
        self.horizon, self._step, self._frame = last - first, first, first + chosen
        return self._frames()

    def logged(self) -> Array | None:
        """The action that was logged in this state."""
        return np.asarray(self._log.actions[self._step], np.float64)

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Go on to the next recorded state, with its recorded reward."""
        reward, ended = self._log.rewards[self._step], self._log.terminated[self._step]
        self._step, self._frame = self._step + 1, self._frame + 1
        return self._frames(), np.full(COPIES, float(reward)), np.full(COPIES, bool(ended))

    def _frames(self) -> Array:
        return np.repeat(np.asarray(self._log.frames[self._frame], np.float64)[None], COPIES, 0)


def plant_of(card: DatasetCard, log: OfflineDataset | None) -> Plant:
    """The system that a log's card names, or else the log.

    Raises:
        ValueError: There is neither.
    """
    if card.environment in SYSTEMS:
        return Twins(card)
    if log is None:
        raise ValueError(f"{card.name} names no registered system, and its log is not at hand.")
    return Recorded(log)
