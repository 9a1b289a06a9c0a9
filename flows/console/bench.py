"""What one window operates: a session, its recording, and whether it runs."""

from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.environments.systems import SYSTEMS, WORLD
from components.environments.world.plane import CENTRE, SIDE
from components.evaluation.guarantee import USUAL, Guarantee
from components.operating.flying import Flying
from components.operating.operable import Operable
from components.operating.recording import Recording
from components.operating.session import Session, Step
from components.operating.shown import goals_of, places_of_map, shown_of

__all__ = ["MOST", "Bench"]

MOST: Final = 36_000
"""Steps of a recording: an hour at ten a second."""


class Bench:
    """A session that is looked at.

    Args:
        operable: What is operated.
        policy: Id under which it was chosen.
        seed: Of starts and noise.
        guarantee: Of the autopilot.

    Attributes:
        session: The session.
        last: Its last step.
        pilot: The autopilot; None where there is no system.
        recording: All of its steps.
        running: Whether it goes on by itself.
        strips: What is drawn over time.
    """

    def __init__(
        self,
        operable: Operable,
        policy: str,
        seed: int = 0,
        guarantee: Guarantee = USUAL,
    ) -> None:
        self._operable, self._policy, self._seed = operable, policy, seed
        self._guarantee = guarantee
        real = operable.card.environment in SYSTEMS
        self.pilot = (
            Flying(operable.card, guarantee) if real else None
        )  # nothing can be tried on a log
        self.session = Session(operable, seed, self.pilot)
        self.recording = Recording(operable, policy, seed)
        self.running = True
        self.strips = shown_of(self.session)
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
        """Forget the recording and begin again, from the first start, as it is operated now."""
        session = self.session
        fresh = Bench(self._operable, self._policy, self._seed, self._guarantee)
        fresh.session.proximity, fresh.session.driver = session.proximity, session.driver
        if session.plant.setpoint is not None:
            fresh.session.plant.demand(session.plant.setpoint)
        self.session, self.recording, self.pilot = fresh.session, fresh.recording, fresh.pilot
        self.running = True

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
            "values": [[_round(v) for v in of(done)] for _, of in self.strips],
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
        places = places_of_map()
        actions = self.session.actions_at(places)
        return np.concatenate([places, actions], axis=1).round(3).tolist()

    def scenery(self) -> dict[str, Any]:
        """What the map shows beside policies."""
        goals = goals_of(self._operable)
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


def _round(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None
