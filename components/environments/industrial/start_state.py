"""The state in which the Industrial Benchmark starts, checked at every reset.

The reference starts at velocity = gain = shift = 50 with its hidden state at rest. Every value may
be set, as one number for all copies or one for each.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from components.environments.industrial.goldstone import encode_latents

__all__ = ["START_DEFAULTS", "StartState"]

Array = NDArray[np.float64]

START_DEFAULTS: Final[Mapping[str, float]] = MappingProxyType(
    {
        "velocity": 50.0,
        "gain": 50.0,
        "shift": 50.0,
        "hidden_velocity": 0.0,
        "hidden_gain": 0.0,
        "domain": 1.0,
        "response": 1.0,
        "direction": 0.0,
    }
)
"""Start values by name; `operational_costs` may be set as well."""

_PAST_COSTS = "operational_costs"
_PAST_STEPS = 10
_RANGES = {
    "velocity": (0.0, 100.0),
    "gain": (0.0, 100.0),
    "shift": (0.0, 100.0),
    "hidden_velocity": (0.0, 5.0),
    "hidden_gain": (0.0, 5.0),
    "domain": (-1.0, 1.0),
    "response": (-1.0, 1.0),
    "direction": (-6.0, 6.0),
}


@dataclass(frozen=True)
class StartState:
    """Checked start values of N copies.

    Attributes:
        steerings: `[3, N]` velocity, gain and shift.
        hidden: `[2, N]` latents of equations 3.26 and 3.27, velocity first.
        latents: `[N]` index of domain, response and direction (`goldstone.encode_latents`).
        operational_costs: `[10, N]` oldest first, or None for the cost of the steerings.
    """

    steerings: Array
    hidden: Array
    latents: NDArray[np.intp]
    operational_costs: Array | None

    @classmethod
    def resolve(cls, start: Mapping[str, ArrayLike], copies: int) -> "StartState":
        """Fill in the defaults and check every value.

        Args:
            start: values by name; numbers or `[N]`, and `operational_costs` `[10]` or `[N, 10]`.
            copies: N.

        Raises:
            ValueError: an unknown name, a wrong shape or a value out of range.
        """
        for name in start:
            if name not in START_DEFAULTS and name != _PAST_COSTS:
                known = ", ".join([*START_DEFAULTS, _PAST_COSTS])
                raise ValueError(f"unknown start value {name!r}; known are {known}.")
        values = {
            name: _spread(name, start.get(name, default), copies)
            for name, default in START_DEFAULTS.items()
        }
        latents = np.stack([values["domain"], values["response"], values["direction"]], axis=1)
        if not np.array_equal(latents, np.rint(latents)):
            raise ValueError("start values domain, response and direction must be whole numbers.")
        index = [encode_latents(*(int(value) for value in row)) for row in latents]
        costs = start.get(_PAST_COSTS)
        return cls(
            steerings=np.stack([values["velocity"], values["gain"], values["shift"]]),
            hidden=np.stack([values["hidden_velocity"], values["hidden_gain"]]),
            latents=np.array(index, dtype=np.intp),
            operational_costs=None if costs is None else _past_costs(costs, copies),
        )


def _spread(name: str, value: ArrayLike, copies: int) -> Array:
    """A start value as `[copies]`, checked against its range."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (copies,)):
        raise ValueError(
            f"start value {name!r} has the shape {array.shape}; give a number or [{copies}]."
        )
    low, high = _RANGES[name]
    if not bool(np.all((array >= low) & (array <= high))):
        raise ValueError(f"start value {name!r} is {array}; give numbers from {low} to {high}.")
    return np.broadcast_to(array, (copies,))


def _past_costs(value: ArrayLike, copies: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((_PAST_STEPS,), (copies, _PAST_STEPS)):
        raise ValueError(
            f"start value {_PAST_COSTS!r} has the shape {array.shape}; give [{_PAST_STEPS}] or "
            f"[{copies}, {_PAST_STEPS}], oldest first."
        )
    if not bool(np.all(array >= 0.0)):
        raise ValueError(f"start value {_PAST_COSTS!r} holds a negative number; costs are not.")
    return np.broadcast_to(array, (copies, _PAST_STEPS)).T
