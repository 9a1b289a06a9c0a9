"""What the values of a log must be: checked wherever one is made, written, opened or imported.

A digest says that bytes are those that were written. It does not say that they make sense: a log
of missing sensor values, or of actions in per cent, has a digest like any other. There is no
tolerance: all sources of this project clip actions to [-1, 1] in single precision, so a value
beyond is either rounding, which its owner should clip, or another unit.

Every check reads an array once, in blocks, so that memory-mapped logs of any size can be checked.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.card import DatasetCard

__all__ = ["check_arrays", "check_card", "check_log"]

_TYPES: Final = {
    "frames": (np.float32, 2),
    "actions": (np.float32, 2),
    "rewards": (np.float32, 1),
    "terminated": (np.bool_, 1),
    "truncated": (np.bool_, 1),
    "episode_starts": (np.int64, 1),
}
"""Type and number of axes of every array."""
_BLOCK: Final = 1 << 16  # rows looked at together
_ROUNDING: Final = 1e-3  # beyond 1 by less than this: said to be rounding
_REWARD: Final = "reward"
"""A feature of dynamics specifications that every log has."""


def check_log(card: DatasetCard, arrays: Mapping[str, NDArray[Any]], source: object) -> None:
    """Refuse a log whose values cannot be, or whose card describes another one.

    Args:
        card: Of the log.
        arrays: Those of :class:`~components.data.dataset.OfflineDataset`, by name.
        source: What the log is called in messages.

    Raises:
        ValueError: One sentence about the first fault.
    """
    check_card(card, source)
    check_arrays(arrays, card.frame_features, card.action_features, source)
    lengths = np.diff(arrays["episode_starts"])
    found = {"trajectories": len(lengths), "transitions": int(lengths.sum())}
    found["steps"] = int(lengths.max())
    for name, value in found.items():
        if getattr(card, name) != value:
            raise ValueError(
                f"{source}: the card says {name}={getattr(card, name)}, but the arrays have "
                f"{value}; correct the card."
            )


def check_card(card: DatasetCard, source: object) -> None:
    """Refuse a card with fields that cannot be, whatever the arrays are.

    Raises:
        ValueError: One sentence about the first fault.
    """
    for what, names in (("frame", card.frame_features), ("action", card.action_features)):
        if not names or len(set(names)) < len(names):
            raise ValueError(
                f"{source}: the names of {what} features are {', '.join(names) or 'missing'}; give "
                "each feature a name of its own."
            )
    if not 0 < card.discount <= 1:
        raise ValueError(
            f"{source}: the discount on the card is {card.discount}; it must be above 0 and at "
            "most 1."
        )
    for name in ("history", "return_steps"):
        if getattr(card, name) < 1:
            raise ValueError(f"{source}: {name} is {getattr(card, name)} on the card; at least 1.")
    for name in vars(card):
        if name.endswith(("_mean", "_min", "_max")) and not np.isfinite(getattr(card, name)):
            raise ValueError(
                f"{source}: {name} is {getattr(card, name)} on the card; the rewards are too large "
                "or undefined, so scale them."
            )
    if card.action_bounds and (
        len(card.action_bounds) != len(card.action_features)
        or not all(low < high for low, high in card.action_bounds)
    ):
        raise ValueError(
            f"{source}: action_bounds on the card are {card.action_bounds}; give the smaller and "
            f"the larger one of each of {', '.join(card.action_features)}."
        )
    known = {*card.frame_features, *card.action_features, _REWARD}
    unknown = [name for name in _dynamics_features(card.dynamics) if name not in known]
    if unknown:
        raise ValueError(
            f"{source}: the dynamics specification on the card names {', '.join(unknown)}, which "
            "the log does not have; correct the name."
        )


def _dynamics_features(dynamics: Mapping[str, Any]) -> list[str]:
    """All features that a dynamics specification names."""
    known = dynamics.get("known", {}).get("features", ())
    parts: Iterable[Iterable[str]] = (
        known,
        *(dynamics.get(name, ()) for name in ("learned", "reward", "healthy")),
    )
    return list(dict.fromkeys(name for part in parts for name in part))


def check_arrays(
    arrays: Mapping[str, NDArray[Any]],
    frame_features: Sequence[str],
    action_features: Sequence[str],
    source: object,
) -> None:
    """Refuse arrays that are no log.

    Args:
        arrays: Those of :class:`~components.data.dataset.OfflineDataset`, by name.
        frame_features: Names of the columns of `frames`.
        action_features: Names of the columns of `actions`.
        source: What the log is called in messages.

    Raises:
        ValueError: One sentence about the first fault.
    """
    _check_types(arrays, source)
    _check_episodes(arrays, source)
    columns = {"frames": frame_features, "actions": action_features}
    for name, features in columns.items():
        if arrays[name].shape[1] != len(features):
            raise ValueError(
                f"{source}: {name} have {arrays[name].shape[1]} columns for the {len(features)} "
                f"features {', '.join(features)}; name each column."
            )
    for name in ("frames", "actions", "rewards"):
        _check_finite(name, arrays[name], columns.get(name, ()), source)
    _check_range(arrays["actions"], action_features, source)


def _check_types(arrays: Mapping[str, NDArray[Any]], source: object) -> None:
    missing = [name for name in _TYPES if name not in arrays]
    if missing or len(arrays) != len(_TYPES):
        unknown = [name for name in arrays if name not in _TYPES]
        faults = [f"lacks {', '.join(missing)}"] * bool(missing)
        faults += [f"has the unknown {', '.join(unknown)}"] * bool(unknown)
        raise ValueError(
            f"{source} {' and '.join(faults)}; the arrays of a log are {', '.join(_TYPES)}."
        )
    for name, (kind, axes) in _TYPES.items():
        array = arrays[name]
        if array.dtype != kind or array.ndim != axes:
            raise ValueError(
                f"{source}: {name} is {array.dtype} with {array.ndim} axes; give "
                f"{np.dtype(kind)} with {axes}."
            )


def _check_episodes(arrays: Mapping[str, NDArray[Any]], source: object) -> None:
    starts, transitions = arrays["episode_starts"], len(arrays["rewards"])
    wrong = np.flatnonzero(np.diff(starts) <= 0)
    if len(starts) < 2 or starts[0] != 0 or starts[-1] != transitions or len(wrong):
        where = f"entry {wrong[0] + 1} is {starts[wrong[0] + 1]}" if len(wrong) else "they are not"
        if not len(wrong) and len(starts):
            where = f"they go from {starts[0]} to {starts[-1]}"
        raise ValueError(
            f"{source}: episode_starts must increase from 0 to the number of transitions, "
            f"{transitions}, but {where}; give the first transition of each episode, and that "
            "number."
        )
    rows = {name: transitions for name in ("actions", "terminated", "truncated")}
    rows["frames"] = transitions + len(starts) - 1
    for name, expected in rows.items():
        if len(arrays[name]) != expected:
            raise ValueError(
                f"{source}: {name} has {len(arrays[name])} rows, but {transitions} transitions of "
                f"{len(starts) - 1} episodes need {expected}; an episode has one frame more than "
                "actions."
            )
    ends = starts[1:] - 1
    for name in ("terminated", "truncated"):
        inside = np.array(arrays[name])
        inside[ends] = False
        if inside.any():
            raise ValueError(
                f"{source}: {name} is set in row {inside.argmax()}, which is not the last of its "
                f"episode ({int(inside.sum())} such rows); let a new episode start after it."
            )
    open_ended = np.flatnonzero(~(arrays["terminated"][ends] | arrays["truncated"][ends]))
    if len(open_ended):
        raise ValueError(
            f"{source}: episode {open_ended[0]} ends in row {ends[open_ended[0]]} neither "
            f"terminated nor truncated ({len(open_ended)} such episodes); set truncated there if "
            "it was merely cut."
        )


def _blocks(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """The rows of an array, some at a time."""
    for begin in range(0, len(array), _BLOCK):
        yield np.asarray(array[begin : begin + _BLOCK])


def _check_finite(name: str, array: NDArray[Any], features: Sequence[str], source: object) -> None:
    if all(np.isfinite(block).all() for block in _blocks(array)):
        return
    wrong = np.concatenate([~np.isfinite(block) for block in _blocks(array)])
    raise ValueError(
        f"{source}: {_first(name, array, wrong, features)}; a log has no missing or infinite "
        "values, so repair them or leave their episodes out."
    )


def _check_range(actions: NDArray[Any], features: Sequence[str], source: object) -> None:
    if all(np.abs(block).max(initial=0.0) <= 1.0 for block in _blocks(actions)):
        return
    wrong = np.concatenate([np.abs(block) > 1.0 for block in _blocks(actions)])
    largest = max(np.abs(block).max(initial=0.0) for block in _blocks(actions))
    rounding = largest < 1.0 + _ROUNDING
    remedy = "clip what is rounding" if rounding else "scale them (are they in per cent?)"
    raise ValueError(
        f"{source}: {_first('actions', actions, wrong, features)}, the largest {largest!s}; "
        f"actions lie in [-1, 1], so {remedy}."
    )


def _first(
    name: str, array: NDArray[Any], wrong: NDArray[np.bool_], features: Sequence[str]
) -> str:
    """Where the first wrong value is, what it is, and how many there are."""
    place = tuple(int(n) for n in np.unravel_index(int(wrong.argmax()), wrong.shape))
    column = f" of {features[place[1]]!r}" if features else ""
    count = int(wrong.sum())
    more = f" ({count} such values)" if count > 1 else ""
    return f"{name} hold {array[place]!s} in row {place[0]}{column}{more}"
