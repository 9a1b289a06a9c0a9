"""What one window operates: a session, its recording, and whether it runs."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.environments.systems import SYSTEMS, WORLD
from components.environments.world.plane import CENTRE, SIDE
from components.operating.operable import Operable
from components.operating.recording import Recording
from components.operating.session import Pilot, Session, Step

__all__ = ["Bench", "Strip"]

MOST: Final = 36_000
"""Steps of a recording: an hour at ten a second."""
_ARROWS: Final = 13  # along a side of the map
_STRIPS: Final = 7  # quantities shown at most


@dataclass(frozen=True)
class Strip:
    """A quantity that is drawn over time, for both copies.

    Attributes:
        label: What it is.
        of: Its two values in a step, the operated copy's first.
    """

    label: str
    of: Callable[[Step], NDArray[np.float64]]


class Bench:
    """A session that is looked at.

    Args:
        operable: What is operated.
        policy: Id under which it was chosen.
        seed: Of starts and noise.
        pilot: The third driver, if there is one.

    Attributes:
        session: The session.
        last: Its last step.
        recording: All of its steps.
        running: Whether it goes on by itself.
        strips: What is drawn over time.
    """

    def __init__(
        self, operable: Operable, policy: str, seed: int = 0, pilot: Pilot | None = None
    ) -> None:
        self._operable, self._policy, self._seed, self._pilot = operable, policy, seed, pilot
        self.session = Session(operable, seed, pilot)
        self.recording = Recording(operable, policy, seed)
        self.running = True
        self.strips = _strips(self.session)
        self.last: Step | None = None
        self._map_of: float | None = None

    @property
    def is_map(self) -> bool:
        """Whether the system is the 2-D world."""
        return self._operable.card.environment == WORLD.id

    @property
    def drawable(self) -> bool:
        """Whether the system is one that a camera can see."""
        known = SYSTEMS.get(self._operable.card.environment)
        return known is not None and known.drawable

    @property
    def system(self) -> tuple[str, dict[str, Any]]:
        """Id and parameters of the system."""
        card = self._operable.card
        return card.environment, dict(card.environment_parameters)

    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions and velocities of the operated copy of a robot."""
        plant: Any = self.session.plant
        positions, velocities = plant.systems[0].state()
        return positions[0], velocities[0]

    def turn(self, proximity: object) -> None:
        """Set the proximity to what a browser sent; what is no number in [0, 1] is ignored."""
        if isinstance(proximity, int | float) and 0 <= proximity <= 1:
            self.session.proximity = float(proximity)

    def restart(self) -> None:
        """Forget the recording and begin again, from the first start."""
        session = self.session
        fresh = Bench(self._operable, self._policy, self._seed, self._pilot)
        fresh.session.proximity, fresh.session.driver = session.proximity, session.driver
        self.session, self.recording, self.running = fresh.session, fresh.recording, True

    @property
    def full(self) -> bool:
        """Whether nothing more is recorded."""
        return self.recording.steps >= MOST

    def step(self) -> dict[str, Any]:
        """Act once; returns what a page draws of it."""
        before = self.session.episode
        done = self.last = self.session.step()
        self.recording.add(done)
        self.running = self.running and not self.full
        drawn: dict[str, Any] = {
            "fresh": done.episode != before,
            "proximity": round(done.proximity, 4),
            "values": [[_round(v) for v in strip.of(done)] for strip in self.strips],
        }
        if self.is_map:
            drawn["places"] = self.session.frames[:, :2].round(3).tolist()
            drawn["from"] = done.frames[:, :2].round(3).tolist()
        return drawn

    def arrows(self) -> list[list[float]] | None:
        """Places and actions `[N, 4]` of the map at this proximity; None if they are drawn."""
        if not self.is_map or self._map_of == self.session.proximity:
            return None
        self._map_of = self.session.proximity
        along = np.linspace(0.0, SIDE, _ARROWS)
        places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        actions = self.session.actions_at(places)
        return np.concatenate([places, actions], axis=1).round(3).tolist()

    def scenery(self) -> dict[str, Any]:
        """What the map shows beside policies."""
        goals = self._goals() if self.is_map else []
        return {"map": self.is_map, "side": SIDE, "centre": list(CENTRE), "goals": goals}

    def save(self, folder: Path) -> Path:
        """Write the recording into a new folder below another; returns it."""
        name = f"{datetime.now():%Y-%m-%d-%H%M%S}"
        place, number = folder / name, 1
        while place.exists():
            number += 1
            place = folder / f"{name}-{number}"
        self.recording.save(place)
        return place

    def _goals(self) -> list[list[float]]:
        """Where the behaviour comes to rest: its actions' fixed points, by following it."""
        clone = self._operable.behaviour
        if clone is None:
            return []
        import torch

        along = np.linspace(0.0, SIDE, 5)
        places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        for _ in range(30):
            seen = torch.from_numpy(places).float()[None, :, None]
            places = places + clone.act(seen)[0].numpy()
        found: list[list[float]] = []
        for place in places:
            if all(np.linalg.norm(place - other) > 1.0 for other in found):
                found.append(place.round(2).tolist())
        return found[:4]


def _strips(session: Session) -> list[Strip]:
    """The reward and, of a system, what changes in its frames; of recorded states, the actions."""
    card = session.operable.card

    def of_frame(column: int) -> Callable[[Step], NDArray[np.float64]]:
        return lambda step: step.frames[:, column]

    def of_action(column: int) -> Callable[[Step], NDArray[np.float64]]:
        low, high = card.action_bounds[column] if card.action_bounds else (-1.0, 1.0)
        return lambda step: low + (step.actions[:, column] + 1) / 2 * (high - low)

    reward = Strip("reward", lambda step: step.rewards)
    if card.environment == WORLD.id:
        return [
            reward,
            Strip("distance to the familiar action", lambda step: np.array([step.distance])),
            Strip("distance to the log", lambda step: np.array([step.strangeness])),
        ]
    if session.plant.real:
        names = [
            (number, name)
            for number, name in enumerate(card.frame_features)
            if name != "setpoint" or session.plant.setpoint is None
        ]
        frames = [Strip(name, of_frame(number)) for number, name in names]
        return [*frames[: _STRIPS - 1], reward]
    actions = [Strip(name, of_action(n)) for n, name in enumerate(card.action_features)]
    frames = [Strip(name, of_frame(n)) for n, name in enumerate(card.frame_features)]
    return [*actions, *frames][: _STRIPS - 1] + [reward]


def _round(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None
