"""Where a column seems to change its unit or its sensor, once and for good."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from components.data.imports.columns import Column

__all__ = ["Jump", "find_jump", "jump_warning"]

_BLOCKS: Final = 48
"""Equal parts of a log whose medians and spreads are compared."""
_LEAST_IN_BLOCK: Final = 20
_SAMPLED: Final = 2000  # rows looked at of a block
_JUMP: Final = 4.0
"""A jump moves the medians by so many of their own deviations on either side."""
_SCALED: Final = 4.0  # a change of units multiplies the spread by at least so much


@dataclass(frozen=True)
class Jump:
    """A step from one level to another.

    Attributes:
        row: About where: the first of a part of the log.
        part: Rows of such a part, by which the step may be earlier or later.
        kind: What steps, `median` or `spread`.
        before: Its level before the step.
        after: And after it.
    """

    row: int
    part: int
    kind: str
    before: float
    after: float


def jump_warning(column: Column) -> list[str]:
    """A sentence about the jump of a column, if there is one."""
    found = find_jump(column.values)
    if found is None:
        return []
    if found.kind == "median":
        before, after = (column.in_log_units(level) for level in (found.before, found.after))
        what = f"its median goes from {before:.6g} to {after:.6g} and stays there"
    else:
        what = f"its spread changes by a factor of {found.after / found.before:.3g} and stays so"
    begins = _first_of_file(column, found)
    if begins is None:
        return [
            f"{column.place(found.row)}: about here {column.shown} seems to change its unit or its "
            f"sensor: {what}."
        ]
    return [
        f"{column.place(begins)}, where this file begins: {column.shown} seems to be in another "
        f"unit than in {column.source(begins - 1)}: {what}; convert the file."
    ]


def _first_of_file(column: Column, jump: Jump) -> int | None:
    """The row of a jump if it is the first one of a file, else None."""
    low, high = max(0, jump.row - jump.part), min(len(column.values) - 1, jump.row + jump.part)
    source = column.source(high)
    if column.source(low) == source:
        return None
    while high - low > 1:  # the file begins above `low`, at the latest in `high`
        middle = (low + high) // 2
        low, high = (low, middle) if column.source(middle) == source else (middle, high)
    near = min(jump.part, _SAMPLED)
    sides = column.values[max(0, high - near) : high], column.values[high : high + near]
    levels = []
    for side in sides:
        quarter, middle_value, three = np.percentile(side.astype(np.float64), (25, 50, 75))
        levels.append(middle_value if jump.kind == "median" else three - quarter)
    # Each side is at its own level: in the middle between them the step would be elsewhere.
    between = (jump.before + jump.after) / 2
    if jump.kind == "spread":
        between = math.sqrt(jump.before * jump.after)
    apart = (levels[0] < between) != (levels[1] < between)
    return high if apart and (levels[0] < between) == (jump.before < between) else None


def find_jump(values: NDArray[np.float32]) -> Jump | None:
    """Where a column seems to have changed its unit; None where it did not.

    The medians of equal parts of the column lie in two groups, before and after one part, that are
    further apart than `_JUMP` of their deviations within the groups; or so do the spreads.

    Args:
        values: `[R]` in the order of the log.
    """
    blocks = min(_BLOCKS, len(values) // _LEAST_IN_BLOCK)
    if blocks < 6:
        return None
    size = len(values) // blocks
    edges = np.linspace(0, len(values), blocks + 1).astype(int)
    parts = []
    for begin, end in pairwise(edges):
        step = max(1, (end - begin) // _SAMPLED)
        parts.append(np.percentile(values[begin:end:step].astype(np.float64), (25, 50, 75)))
    low, middle, high = np.stack(parts, axis=1)
    spread = high - low
    typical = float(np.median(spread))
    found = _change(middle, floor=typical / 2)
    if found is not None:
        k, before, after = found
        return Jump(int(edges[k]), size, "median", before, after)
    if (spread > 0).all():
        found = _change(np.log(spread), floor=math.log(_SCALED) / _JUMP)
        if found is not None:
            k, before, after = found
            return Jump(int(edges[k]), size, "spread", math.exp(before), math.exp(after))
    return None


def _change(values: NDArray[np.float64], floor: float) -> tuple[int, float, float] | None:
    """The block where values step from one level to another; with the levels."""
    best: tuple[float, int, float, float] | None = None
    for k in range(3, len(values) - 2):
        left, right = values[:k], values[k:]
        if not (left.max() < right.min() or right.max() < left.min()):
            continue
        before, after = float(np.median(left)), float(np.median(right))
        # A change of units takes one row, while drifts and random walks take many blocks.
        if abs(values[k + 1] - values[k - 1]) < abs(after - before) / 2:
            continue
        within = 1.4826 * max(
            float(np.median(np.abs(left - before))), float(np.median(np.abs(right - after)))
        )
        scale = max(within, floor, 1e-9 * max(abs(before), abs(after), 1e-30))
        score = abs(after - before) / scale
        if score > _JUMP and (best is None or score > best[0]):
            best = (score, k, before, after)
    return None if best is None else best[1:]
