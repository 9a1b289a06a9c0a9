"""What the values of a log tell about it: columns that say nothing, and what looks wrong.

Columns that never change and columns that are copies of others are refused. Everything else is a
sentence of warning: the log can be used, and its owner knows better what it means.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.imports.schema import LogError

__all__ = ["Column", "find_jump", "refuse_empty_columns", "reward_explained", "warnings_about"]

_BLOCKS: Final = 48
"""Equal parts of a log whose medians and spreads are compared."""
_LEAST_IN_BLOCK: Final = 20
_PROBE: Final = 1000  # rows compared first
_SAMPLED: Final = 2000  # rows looked at of a block
_JUMP: Final = 4.0
"""A jump moves the medians by so many of their own deviations on either side."""
_SCALED: Final = 4.0  # a change of units multiplies the spread by at least so much
_FITTED: Final = 20_000  # transitions that the reward is fitted to
_EXPLAINED: Final = 0.2
"""Share of the reward's variance below which the features are said to leave it unexplained."""


@dataclass(frozen=True)
class Column:
    """A column of a log.

    Attributes:
        name: Of the column.
        role: `feature`, `action` or `reward`.
        values: `[R]` float32.
        place: File and row of a value.
    """

    name: str
    role: str
    values: NDArray[Any]
    place: Callable[[int], str]


def refuse_empty_columns(
    columns: Sequence[Column], at_steps: Callable[[int, int | None], NDArray[Any]]
) -> None:
    """Refuse columns that never change, and copies of others.

    Args:
        columns: Features and actions.
        at_steps: Values of the n-th one in the log's units, in rows where a step begins; so many
            of the first, or all.

    Raises:
        LogError: Names the columns, and their first row.
    """
    for column in columns:
        values = column.values
        if (values == values[0]).all():
            raise LogError(
                f"{column.place(0)}: {column.role} {column.name!r} has one value here and in all "
                "rows after it; leave out a column that never changes."
            )
    for one, other in combinations(range(len(columns)), 2):
        # Most columns differ within the first rows, so the others are seldom made.
        if all(_equal(at_steps(one, rows), at_steps(other, rows)) for rows in (_PROBE, None)):
            first, second = columns[one], columns[other]
            raise LogError(
                f"{first.place(0)}: {first.role} {first.name!r} equals {second.role} "
                f"{second.name!r} here and in all rows after it; leave one of them out."
            )


def _equal(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two columns are one, but for single precision, which has rounded both."""
    near = 1e-6 * max(abs(float(one.max())), abs(float(one.min())))
    return bool(np.abs(one - other).max() <= near)


def find_jump(values: NDArray[np.float32]) -> tuple[int, str] | None:
    """Where a column seems to have changed its unit, once and for good.

    The medians of equal parts of the column lie in two groups, before and after one part, that are
    further apart than `_JUMP` of their deviations within the groups; or so do the spreads.

    Args:
        values: `[R]` in the order of the log.

    Returns:
        The first row of the later group and what changed; None where nothing did.
    """
    size = len(values) // _BLOCKS
    blocks = _BLOCKS if size >= _LEAST_IN_BLOCK else len(values) // _LEAST_IN_BLOCK
    if blocks < 6:
        return None
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
        return int(edges[k]), f"its median goes from {before:g} to {after:g} and stays there"
    if (spread > 0).all():
        found = _change(np.log(spread), floor=math.log(_SCALED) / _JUMP)
        if found is not None:
            k, before, after = found
            factor = math.exp(after - before)
            return int(edges[k]), f"its spread changes by a factor of {factor:.3g} and stays so"
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


def reward_explained(arrays: Mapping[str, NDArray[Any]]) -> float | None:
    """Share of the reward's variance that a fit by the features explains.

    The fit is linear in the next frame, the frame, the action, and their squares.

    Args:
        arrays: Of the dataset.

    Returns:
        At most 1, adjusted for the number of terms; None where the reward does not vary or the log
        is too short to tell.
    """
    count = len(arrays["rewards"])
    chosen = np.unique(np.linspace(0, count - 1, min(count, _FITTED)).astype(np.int64))
    episode = np.searchsorted(arrays["episode_starts"], chosen, side="right") - 1
    frames, rows = arrays["frames"], chosen + episode
    terms = np.concatenate([frames[rows + 1], frames[rows], arrays["actions"][chosen]], axis=1)
    terms = terms.astype(np.float64)
    terms = (terms - terms.mean(axis=0)) / np.maximum(terms.std(axis=0), 1e-12)
    terms = np.concatenate([terms, terms**2, np.ones((len(terms), 1))], axis=1)
    rewards = arrays["rewards"][chosen].astype(np.float64)
    varies = rewards.var()
    if varies == 0 or len(chosen) < 5 * terms.shape[1]:
        return None
    weights, *_ = np.linalg.lstsq(terms, rewards, rcond=None)
    left = float(np.mean((rewards - terms @ weights) ** 2) / varies)
    share: float = 1 - left * (len(chosen) - 1) / (len(chosen) - terms.shape[1])
    return share


def warnings_about(
    columns: Sequence[Column], arrays: Mapping[str, NDArray[Any]], history: int, fitted: bool
) -> list[str]:
    """Sentences about what looks wrong.

    Args:
        columns: Of the log.
        arrays: Of the dataset.
        history: Rows that a policy sees.
        fitted: Whether the reward is a column, so that features may not explain it.
    """
    said = []
    for column in columns:
        jump = find_jump(column.values)
        if jump is not None:
            row, what = jump
            said.append(
                f"{column.place(row)}: about here {column.role} {column.name!r} seems to change "
                f"its unit or its sensor: {what}."
            )
        said += _odd_action(column) if column.role == "action" else _coarse(column)
    lengths = np.diff(arrays["episode_starts"])
    short = int((lengths < history).sum())
    if short:
        said.append(
            f"{short} of {len(lengths)} episodes have fewer steps than the history of {history}; "
            "their first row is repeated in it."
        )
    rewards = arrays["rewards"]
    if (rewards == rewards[0]).all():
        if not arrays["terminated"].any():
            said.append(f"The reward is {rewards[0]:g} in every step: nothing can be learned.")
    elif fitted:
        share = reward_explained(arrays)
        if share is not None and share < _EXPLAINED:
            said.append(
                f"No feature explains the reward: a fit by states, actions and their squares "
                f"explains {max(share, 0.0):.0%} of it; is a column missing, or outcome_row wrong?"
            )
    return said


def _odd_action(column: Column) -> list[str]:
    """Warnings about the values of an action, scaled to [-1, 1]."""
    values = column.values
    low, high = float(values.min()), float(values.max())
    if high - low < 0.1:
        return [
            f"Action {column.name!r} uses {(high - low) / 2:.1%} of the range between its bounds; "
            "are they in another unit? Little can be learned beyond what was tried."
        ]
    few = np.unique(values[:: max(1, len(values) // 10_000)])
    if len(few) <= 5:
        return [
            f"Action {column.name!r} takes {len(few)} values only; policies choose values between "
            "them, too."
        ]
    return []


def _coarse(column: Column) -> list[str]:
    values = column.values
    sample = values[:: max(1, len(values) // 10_000)].astype(np.float64)
    size, spread = float(np.abs(sample).max()), float(sample.std())
    if 0 < spread < 1e-5 * size:
        return [
            f"{column.role.capitalize()} {column.name!r} varies by {spread:.3g} about {size:.6g}, "
            "which single precision hardly resolves; subtract a constant in the log."
        ]
    return []
