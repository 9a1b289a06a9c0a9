"""What the autopilot guarantees, and what it assumes, in shares of the behaviour's return.

Here stand the only defaults: the study, the library and the console begin with the same ones.
"""

import math
from dataclasses import dataclass
from typing import Final

__all__ = ["USUAL", "Guarantee"]


@dataclass(frozen=True)
class Guarantee:
    """How careful the autopilot is, in shares of the size of the behaviour's mean return.

    Attributes:
        margin: What a trajectory may cost on average, beside the behaviour's return.
        slope: How much the return falls at most per unit of proximity; by default a fifth of the
            behaviour's return in a step of 0.05.

    Raises:
        ValueError: One of them is no positive number.
    """

    margin: float = 0.1
    slope: float = 4.0

    def __post_init__(self) -> None:
        """Check both."""
        for name in ("margin", "slope"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}={value} must be a positive number.")


USUAL: Final = Guarantee()
"""What is taken where nobody says anything."""
