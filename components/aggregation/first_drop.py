"""The strategy of thesis 6.6.1: loosen a trade-off in small steps and stop at the first drop.

Start where policies are most constrained. As long as a step earns more, take the next; where it
earns less, stop and go back to the last point that was the best.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Search", "stop_at_first_drop"]


@dataclass(frozen=True)
class Search:
    """How a search ended.

    Attributes:
        chosen: Index of the point that is kept.
        tried: Number of points that were deployed, the start and the drop included.
        worst: Least return of a point that was deployed.
    """

    chosen: int
    tried: int
    worst: float


def stop_at_first_drop(returns: Sequence[float]) -> Search:
    """Walk along the returns of a trade-off, the most constrained policy first.

    A step that changes nothing is no drop; the point before it is kept until one is better. An
    undefined return, NaN, is a drop.

    Args:
        returns: One per step; at least one, the first of which is defined.

    Raises:
        ValueError: There is none, or the first is undefined.
    """
    if not returns or math.isnan(returns[0]):
        raise ValueError("a search needs a start whose return is known.")
    best = 0
    for step, value in enumerate(returns):
        if value > returns[best]:
            best = step
        elif not value >= returns[best]:
            deployed = [r for r in returns[: step + 1] if not math.isnan(r)]
            return Search(best, step + 1, min(deployed))
    return Search(best, len(returns), min(returns))
