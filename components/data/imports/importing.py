"""From tables and their schema to a dataset with its card, and what is to be said about it."""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.assembly import assemble
from components.data.dataset import OfflineDataset
from components.data.dynamics import REWARD
from components.data.imports.columns import Column
from components.data.imports.episodes import Episodes, find_episodes
from components.data.imports.quality import refuse_empty_columns, warnings_about
from components.data.imports.rows import Collector, Rows
from components.data.imports.schema import Known, LogError, LogSchema, Repairs
from components.data.imports.tables import Table, check_columns

__all__ = ["Imported", "import_tables"]

_EXACT: Final = 1e-3
"""Largest deviation of a known feature, as a share of its bounds: logs are rounded."""


@dataclass(frozen=True)
class Imported:
    """An imported log.

    Attributes:
        dataset: With its card.
        rows: Number of rows that were read.
        notes: Sentences about what was dropped, cut, filled in or clipped.
        warnings: Sentences about what looks wrong.
    """

    dataset: OfflineDataset
    rows: int
    notes: list[str]
    warnings: list[str]


def import_tables(
    tables: Sequence[Table],
    schema: LogSchema,
    repairs: Repairs,
    name: str,
    progress: Callable[[str, int], None] = lambda table, rows: None,
) -> Imported:
    """Read a log and make a dataset of it.

    Args:
        tables: In the order of the log.
        schema: What their columns mean.
        repairs: What to do about a log that is not whole.
        name: Of the dataset.
        progress: Told the name of a table and the rows read of all so far, after each batch.

    Raises:
        LogError: The log cannot be used; one sentence with file, row and column.
    """
    for table in tables:
        check_columns(table, schema)
    collector, count = Collector(schema), 0
    for table in tables:
        for batch in table.batches(schema):
            collector.add(batch)
            count += batch.rows
            progress(table.name, count)
    rows = collector.finish()
    episodes = find_episodes(rows, schema, repairs)
    notes = list(episodes.notes)
    if rows.clipped:
        notes.append(f"{rows.clipped} actions outside of their bounds by rounding are clipped.")
    layout = _Layout.of(schema)
    arrays, columns = _arrays(rows, episodes, schema, layout)
    del rows
    gc.collect()
    refuse_empty_columns(columns[:-1], _at_steps(arrays, layout))
    warnings = warnings_about(
        columns,
        arrays,
        schema.history,
        fitted=not schema.weights,
        same_row=schema.same_row,
    )
    if schema.known is not None:
        _check_known(arrays, schema, layout, columns[0].place)
    try:
        dataset = assemble(
            arrays,
            discount=schema.discount,
            frame_features=layout.features,
            action_features=layout.actions,
            name=name,
            environment="",
            environment_parameters={},
            controller=schema.controller,
            epsilon=0.0,
            seed=0,
            history=schema.history,
            dynamics=_dynamics(schema, layout),
            action_bounds=layout.bounds,
            sampling=schema.sampling or 0.0,
        )
    except ValueError as error:
        raise LogError(str(error)) from error
    return Imported(dataset, count, notes, warnings)


@dataclass(frozen=True)
class _Layout:
    """Features and actions in the order of the dataset, in which known ones come first.

    Attributes:
        features: Names of the features.
        feature_columns: Index of each in the schema's features.
        actions: Names of the actions; one that a feature follows has its name.
        action_columns: Index of each in the schema's actions.
        bounds: Of each action.
    """

    features: tuple[str, ...]
    feature_columns: tuple[int, ...]
    actions: tuple[str, ...]
    action_columns: tuple[int, ...]
    bounds: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, schema: LogSchema) -> "_Layout":
        """The layout of a schema's dataset."""
        columns = tuple(schema.actions)
        features, actions = schema.features, columns
        if schema.known is not None:
            actions = tuple(schema.known.features)
            columns = tuple(follower.action for follower in schema.known.features.values())
            features = (*actions, *(name for name in features if name not in actions))
        order = tuple(schema.actions)
        return cls(
            features=features,
            feature_columns=tuple(schema.features.index(name) for name in features),
            actions=actions,
            action_columns=tuple(order.index(name) for name in columns),
            bounds=tuple(schema.actions[name] for name in columns),
        )


def _arrays(
    rows: Rows, episodes: Episodes, schema: LogSchema, layout: _Layout
) -> tuple[dict[str, NDArray[Any]], list[Column]]:
    """The arrays of the dataset, and its columns with their places in the log."""
    begins, ends, repeated = episodes.begins, episodes.ends, episodes.repeated
    kept = np.zeros(len(rows.terminal), np.bool_)
    last = np.zeros_like(kept)
    for begin, end in zip(begins, ends, strict=True):
        kept[begin:end] = True
    last[ends - 1] = True
    acting = kept & ~last
    acting[(ends - 1)[repeated]] = True
    after = kept.copy()
    after[begins] = False
    steps = ends - begins - 1 + repeated
    starts = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    terminated = rows.terminal[acting if schema.same_row else after]
    truncated = np.zeros_like(terminated)
    truncated[starts[1:] - 1] = ~terminated[starts[1:] - 1]
    frames = rows.features
    if repeated.any():
        counts = kept.astype(np.int64)
        counts[(ends - 1)[repeated]] = 2
        frames = np.repeat(frames, counts, axis=0)
    elif not kept.all():
        frames = frames[kept]
    arrays = {
        "frames": _ordered(frames, layout.feature_columns),
        "actions": _ordered(rows.actions[acting], layout.action_columns),
        "rewards": rows.rewards[after if schema.reward_after else acting],
        "terminated": terminated,
        "truncated": truncated,
        "episode_starts": starts,
    }
    return arrays, _columns(arrays, rows, begins, schema, layout)


def _columns(
    arrays: dict[str, NDArray[Any]],
    rows: Rows,
    begins: NDArray[np.int64],
    schema: LogSchema,
    layout: _Layout,
) -> list[Column]:
    """Features, actions and the reward, with the rows of the log that they come from."""
    starts = arrays["episode_starts"]
    first_frames = starts + np.arange(len(starts))
    at, of = rows.place, rows.source  # without the arrays of all rows, which are large

    def of_frame(frame: int) -> int:
        episode = int(np.searchsorted(first_frames, frame, side="right")) - 1
        return int(begins[episode] + frame - first_frames[episode])

    def of_step(step: int, later: int = 0) -> int:
        episode = int(np.searchsorted(starts, step, side="right")) - 1
        return int(begins[episode] + step - starts[episode] + later)

    def column(
        name: str, role: str, values: Any, row: Callable[[int], int], **about: Any
    ) -> Column:
        return Column(name, role, values, lambda i: at(row(i)), lambda i: of(row(i)), **about)

    known = schema.known.features if schema.known is not None else ()
    columns = [
        column(name, "feature", arrays["frames"][:, n], of_frame, follows=name in known)
        for n, name in enumerate(layout.features)
    ]
    order = tuple(schema.actions)
    columns += [
        column(order[k], "action", arrays["actions"][:, n], of_step, bounds=layout.bounds[n])
        for n, k in enumerate(layout.action_columns)
    ]
    later = 1 if schema.reward_after else 0
    named = schema.reward or REWARD
    return [
        *columns,
        column(named, "reward", arrays["rewards"], lambda step: of_step(step, later)),
    ]


def _at_steps(
    arrays: dict[str, NDArray[Any]], layout: _Layout
) -> Callable[[int, int | None], NDArray[Any]]:
    """What gives the n-th feature or action in the log's units, where steps begin."""
    ends = arrays["episode_starts"][1:]

    def values(n: int, steps: int | None) -> NDArray[Any]:
        features = len(layout.features)
        if n < features:
            last = ends + np.arange(len(ends))
            column = arrays["frames"][: None if steps is None else 2 * steps, n]
            return np.delete(column, last[last < len(column)])[:steps]
        low, high = layout.bounds[n - features]
        return low + (arrays["actions"][:steps, n - features] + 1) / 2 * (high - low)

    return values


def _ordered(values: NDArray[np.float32], columns: tuple[int, ...]) -> NDArray[np.float32]:
    """An array with its columns in another order; the array itself where it is the same."""
    same = columns == tuple(range(values.shape[1]))
    return values if same else np.ascontiguousarray(values[:, columns])


def _dynamics(schema: LogSchema, layout: _Layout) -> dict[str, Any]:
    """The dynamics specification of the card, see `components/data/dynamics.py`."""
    if schema.known is None:
        ones = [1.0] * len(layout.actions)
        known = {
            "features": list(layout.actions),
            "keep": [0.0] * len(ones),
            "scale": ones,
            "low": -1.0,
            "high": 1.0,
        }
        learned = list(layout.features)
    else:
        known = {
            "features": list(layout.actions),
            "keep": [f.keep for f in schema.known.features.values()],
            "scale": _scales(schema.known, layout),
            "low": float(schema.known.bounds[0]),
            "high": float(schema.known.bounds[1]),
        }
        learned = list(layout.features[len(layout.actions) :])
    weights = dict(schema.weights)
    if not weights or not set(weights) <= set(learned):
        learned, weights = [*learned, REWARD], {REWARD: 1.0}
    return {"known": known, "learned": learned, "reward": weights}


def _scales(known: Known, layout: _Layout) -> list[float]:
    """Effect of each action in [-1, 1]; its bounds are symmetric about 0."""
    return [
        follower.gain * (high - low) / 2
        for follower, (low, high) in zip(known.features.values(), layout.bounds, strict=True)
    ]


def _check_known(
    arrays: dict[str, NDArray[Any]],
    schema: LogSchema,
    layout: _Layout,
    place: Callable[[int], str],
) -> None:
    """Refuse a log whose known features do not follow their actions."""
    assert schema.known is not None
    low, high = schema.known.bounds
    lengths = np.diff(arrays["episode_starts"])
    rows = np.arange(len(arrays["actions"])) + np.repeat(np.arange(len(lengths)), lengths)
    scales = _scales(schema.known, layout)
    for n, (name, follower) in enumerate(schema.known.features.items()):
        before, after = arrays["frames"][rows, n], arrays["frames"][rows + 1, n]
        expected = np.clip(follower.keep * before + scales[n] * arrays["actions"][:, n], low, high)
        wrong = np.abs(after - expected) > _EXACT * (high - low)
        if wrong.any():
            step = int(wrong.argmax())
            raise LogError(
                f"{place(int(rows[step]) + 1)}: {name!r} goes from {before[step]:g} to "
                f"{after[step]:g}, but known says that {follower.action!r} moves it to "
                f"{expected[step]:g} "
                f"({int(wrong.sum())} such steps of {len(wrong)}); correct known or leave it out."
            )
