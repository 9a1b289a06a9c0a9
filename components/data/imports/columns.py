"""A column of a log as the checks of its values see it, which speak in the log's units and rows."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

__all__ = ["Column"]


@dataclass(frozen=True)
class Column:
    """A column of a log.

    Attributes:
        name: Of the column.
        role: `feature`, `action` or `reward`.
        values: `[R]` float32.
        place: File and row of a value.
        source: File of a value.
        bounds: Of an action, whose values are scaled from them to [-1, 1]; None where values are in
            the log's units.
        follows: Whether it follows exactly from an action, so that it rests where the action does.
    """

    name: str
    role: str
    values: NDArray[Any]
    place: Callable[[int], str]
    source: Callable[[int], str]
    bounds: tuple[float, float] | None = None
    follows: bool = False

    @property
    def shown(self) -> str:
        """How sentences begin about it."""
        return f"{self.role} {self.name!r}"

    def in_log_units(self, value: Any) -> Any:
        """A value, or an array of some, in the log's units."""
        if self.bounds is None:
            return value
        low, high = self.bounds
        return low + (value + 1) / 2 * (high - low)
