"""A session as pictures: for films and notebooks, where no browser draws it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from components.environments.systems import WORLD
from components.environments.world.plane import CENTRE, SIDE, reward_at
from components.operating.operable import Operable
from components.operating.session import Session, Step
from components.operating.shown import goals_of, places_of_map, shown_of
from components.reporting.policy_maps import PlaneMap
from components.reporting.session_pictures import SessionPast, session_picture

__all__ = ["Scene"]

_PIXELS: Final = 61  # of the reward along a side


class Scene:
    """A session that is drawn.

    Args:
        session: The session.
        steps: That it will have taken in the end.
    """

    def __init__(self, session: Session, steps: int) -> None:
        self.session = session
        self._shown = shown_of(session)
        self.past = SessionPast([name for name, _ in self._shown], steps)
        self._plane = _plane(session.operable)

    def step(self) -> Step:
        """Act once."""
        fresh = self.session.over
        done = self.session.step()
        past = self.past
        past.proximities.append(done.proximity)
        past.values.append([of(done) for _, of in self._shown])
        past.strayed = self.session.strayed
        if self._plane is not None:
            for copy, trail in enumerate(past.trails):
                if fresh or not trail:
                    trail[:] = [done.frames[copy]]
                trail.append(self.session.frames[copy])
        return done

    def picture(self) -> NDArray[np.uint8]:
        """What it looks like, `[448, 720, 3]`."""
        self.past.proximity = self.session.proximity
        plane = self._plane
        actions = None if plane is None else self.session.actions_at(plane.places)
        return session_picture(self.past, plane, actions)


def _plane(operable: Operable) -> PlaneMap | None:
    if operable.card.environment != WORLD.id:
        return None
    goals = np.array(goals_of(operable)).reshape(-1, 2)
    rewards = reward_at(places_of_map(_PIXELS)).reshape(_PIXELS, _PIXELS)
    return PlaneMap(side=SIDE, places=places_of_map(), rewards=rewards, goals=goals, centre=CENTRE)
