"""What of a session is worth showing, whoever draws it."""

from collections.abc import Callable
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from components.environments.systems import WORLD
from components.environments.world.plane import SIDE
from components.operating.operable import Operable
from components.operating.session import Session, Step

__all__ = ["Shown", "goals_of", "places_of_map", "shown_of"]

Array = NDArray[np.float64]
Shown = tuple[str, Callable[[Step], Array]]
"""The name of a quantity, and its values in a step: the operated copy's and the behaviour's, or one
that only the operated copy has. NaN where there is none."""

_MOST: Final = 7  # quantities shown
_PLACES: Final = 13  # arrows along a side of a map
_APART: Final = 1.0  # between two goals


def shown_of(session: Session) -> list[Shown]:
    """What is worth a curve: reward and frames of a system; of recorded states the actions, too.

    Recorded frames and rewards are what was logged, and no policy's.
    """
    card = session.operable.card

    real = session.plant.real

    def frame(column: int) -> Callable[[Step], Array]:
        return lambda step: step.frames[:, column] if real else _logged(step.frames[1, column])

    def action(column: int) -> Callable[[Step], Array]:
        low, high = card.action_bounds[column] if card.action_bounds else (-1.0, 1.0)
        return lambda step: low + (step.actions[:, column] + 1) / 2 * (high - low)

    reward: Shown = ("reward", lambda step: step.rewards if real else _logged(step.rewards[1]))
    if card.environment == WORLD.id:
        return [
            reward,
            ("distance to the familiar action", lambda step: np.array([step.distance])),
            ("distance to the log", lambda step: np.array([step.strangeness])),
        ]
    frames: list[Shown] = [
        (name, frame(number))
        for number, name in enumerate(card.frame_features)
        if name != "setpoint" or session.plant.setpoint is None
    ]
    if real:
        return [*frames[: _MOST - 1], reward]
    actions: list[Shown] = [(name, action(n)) for n, name in enumerate(card.action_features)]
    return [*[*actions, *frames][: _MOST - 1], reward]


def _logged(value: float) -> Array:
    """What the log alone has."""
    return np.array([np.nan, value])


def goals_of(operable: Operable) -> list[list[float]]:
    """Where the behaviour comes to rest in the 2-D world, found by following it."""
    clone = operable.behaviour
    if clone is None or operable.card.environment != WORLD.id:
        return []
    places = places_of_map(5)
    for _ in range(30):  # it takes 15 steps across the whole world
        seen = torch.from_numpy(places).float()[None, :, None]
        places = places + clone.act(seen)[0].numpy()
    found: list[list[float]] = []
    for place in places:
        if all(np.linalg.norm(place - other) > _APART for other in found):
            found.append(place.round(2).tolist())
    return found[:4]


def places_of_map(points: int = _PLACES) -> Array:
    """Places `[points^2, 2]`, even over the 2-D world, row by row from y = 0 up."""
    along = np.linspace(0.0, SIDE, points)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
