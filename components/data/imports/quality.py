"""What the values of a log tell about it: columns that say nothing, and what looks wrong.

Columns that never change and columns that are copies of others are refused. Everything else is a
sentence of warning: the log can be used, and its owner knows better what it means.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.imports.columns import Column
from components.data.imports.faults import fault_warnings
from components.data.imports.jumps import jump_warning
from components.data.imports.schema import LogError

__all__ = ["outcome_doubt", "refuse_empty_columns", "reward_explained", "warnings_about"]

_PROBE: Final = 1000  # rows compared first
_FITTED: Final = 20_000  # transitions that the reward is fitted to
_EXPLAINED: Final = 0.2
"""Share of the reward's variance below which the features are said to leave it unexplained."""
_MORE: Final = 0.02
"""By so much of the variance another `outcome_row` must explain more, besides half of what the
schema's leaves: both fits have as many terms, so chance alone makes no such difference."""


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


def reward_explained(
    arrays: Mapping[str, NDArray[Any]], rewards_of: NDArray[np.int64] | None = None, shift: int = 0
) -> float | None:
    """Share of the reward's variance that a fit by the features explains.

    The fit is linear in the next frame, the frame, the action, and their squares.

    Args:
        arrays: Of the dataset.
        rewards_of: Steps whose rewards are fitted; by default all, or many of them.
        shift: By how many steps later the frames and actions are that explain a reward; their
            steps must lie in the same episode.

    Returns:
        At most 1, adjusted for the number of terms; None where the reward does not vary or the log
        is too short to tell.
    """
    count = len(arrays["rewards"])
    chosen = _spread(np.arange(count)) if rewards_of is None else rewards_of
    steps = chosen + shift
    episode = np.searchsorted(arrays["episode_starts"], steps, side="right") - 1
    frames, rows = arrays["frames"], steps + episode
    terms = np.concatenate([frames[rows + 1], frames[rows], arrays["actions"][steps]], axis=1)
    terms = terms.astype(np.float64)
    terms = (terms - terms.mean(axis=0)) / np.maximum(terms.std(axis=0), 1e-12)
    terms = np.concatenate([terms, terms**2, np.ones((len(terms), 1))], axis=1)
    rewards = arrays["rewards"][chosen].astype(np.float64)
    if len(chosen) < 5 * terms.shape[1] or rewards.var() == 0:
        return None
    weights, *_ = np.linalg.lstsq(terms, rewards, rcond=None)
    left = float(np.mean((rewards - terms @ weights) ** 2) / rewards.var())
    share: float = 1 - left * (len(chosen) - 1) / (len(chosen) - terms.shape[1])
    return share


def _spread(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most so many steps as are fitted, from all over the log."""
    chosen = np.linspace(0, len(steps) - 1, min(len(steps), _FITTED)).astype(np.int64)
    return steps[np.unique(chosen)]


def outcome_doubt(arrays: Mapping[str, NDArray[Any]], *, same_row: bool) -> str | None:
    """A sentence if the reward rather belongs to the action of another row than the schema says.

    The state of its own row explains a reward either way; what tells is whether the action of that
    row and the state after it explain the rest, or the action and the state of the row before.

    Args:
        arrays: Of the dataset.
        same_row: Whether the schema says that a reward stands in the row of its action.
    """
    starts = arrays["episode_starts"]
    shift = -1 if same_row else 1
    inner = np.ones(len(arrays["rewards"]), np.bool_)
    inner[starts[:-1] if same_row else starts[1:] - 1] = False
    chosen = _spread(np.flatnonzero(inner))
    if not len(chosen):
        return None
    said = reward_explained(arrays, chosen)
    other = reward_explained(arrays, chosen, shift)
    if said is None or other is None:
        return None
    if other - said < _MORE or 1 - other > (1 - said) / 2:
        return None
    rows = ("of its own row", "of the row before it")
    better, worse = rows if not same_row else rows[::-1]
    return (
        f"The action {better} explains the reward better than that {worse} ({other:.0%} of it "
        f"against {said:.0%}, together with the states beside it): should outcome_row be "
        f"{'after' if same_row else 'same'}?"
    )


def warnings_about(
    columns: Sequence[Column],
    arrays: Mapping[str, NDArray[Any]],
    history: int,
    *,
    fitted: bool,
    same_row: bool,
) -> list[str]:
    """Sentences about what looks wrong.

    Args:
        columns: Of the log.
        arrays: Of the dataset.
        history: Rows that a policy sees.
        fitted: Whether the reward is a column, so that features may not explain it.
        same_row: Whether the schema says that a reward stands in the row of its action.
    """
    said = []
    for column in columns:
        said += jump_warning(column)
        said += _odd_action(column) if column.role == "action" else _coarse(column)
    said += fault_warnings(columns, arrays)
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
        doubt = outcome_doubt(arrays, same_row=same_row)
        said += [doubt] if doubt is not None else []
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
