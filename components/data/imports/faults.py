"""Sensors that fail: values that stand still, that mean none, or that only repeat another column.

Everything here is a sentence of warning. Plants rest, saturate and are run by hand, so a column is
judged by what it does itself for the rest of the log, and in doubt nothing is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.imports.columns import Column

__all__ = ["FarValues", "FlatRuns", "fault_warnings", "find_far", "find_flat", "find_linear"]

# Flat runs: where a column that moves stands still.
_MOVES: Final = 10.0
"""A column moves if, but for its flat runs, it keeps a value for fewer rows than this on average.
What is set by hand, counted or switched rests longer and is not judged."""
_FLAT: Final = 20.0
"""A run is flat from so many times that average on: of values that change by chance, the longest
run of ten million rows is about ln(10^7) = 16 times as long as the average one."""
_FLAT_LEAST: Final = 30
"""... and from so many rows on, so that coarse rounding in a quiet hour is no fault."""
_TURNS: Final = 0.1
"""Of a sensor's changes at least this share reverse the one before: noise reverses two thirds of
them, while set points are ramped and computed values run smoothly."""
_HABIT: Final = 5
"""What stands still more often than that, and in most rows, does so by habit."""

# Far values: isolated ones that hardly belong to the column.
_CORES: Final = ((5.0, 95.0), (1.0, 99.0), (0.1, 99.9))
"""Percentiles between which a column is at home: the first pair that differ. Codes for "no value"
in up to a twentieth of the rows leave the first one as it is."""
_NEAR: Final = 3.0
"""Tails reach so many widths of the core beyond it: 12 standard deviations of a normal column."""
_GAP: Final = 4.0
"""Far values are those beyond a gap in which the distance from the core grows by this factor, so
at least twelve widths away: tails that thin out, and plants that cool down, leave no such gap."""
_SAMPLED: Final = 200_000  # rows that percentiles are taken of

# Linear copies.
_RESIDUE: Final = 0.01
"""A copy leaves less than this share of a column's standard deviation to something else than the
other column: what rounding to two digits leaves. Two sensors of one quantity leave their noise."""
_COMPARED: Final = 20_000  # rows that columns are compared in


@dataclass(frozen=True)
class FlatRuns:
    """Flat runs of a column.

    Attributes:
        first: First row of the longest.
        length: Its rows.
        count: Number of flat runs.
        rows: Rows of all of them.
    """

    first: int
    length: int
    count: int
    rows: int


@dataclass(frozen=True)
class FarValues:
    """Isolated values of a column.

    Attributes:
        first: Row of the first.
        count: Number of rows.
        low: Smallest of them.
        high: Largest of them.
        usual: Limits of the core.
    """

    first: int
    count: int
    low: float
    high: float
    usual: tuple[float, float]


def fault_warnings(columns: Sequence[Column], arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    """Sentences about values that look like faults of sensors.

    Args:
        columns: Features, actions and the reward.
        arrays: Of the dataset.
    """
    said = []
    for column in columns:
        if column.role == "feature" and not column.follows:
            said += _flat_sentence(column)
        # A trip's penalty is far from all other rewards, and meant.
        ended = arrays["terminated"] if column.role == "reward" else None
        said += _far_sentence(column, ended)
    return said + _copies(columns, arrays["episode_starts"])


def find_flat(values: NDArray[Any]) -> FlatRuns | None:
    """Where a column that otherwise moves keeps one value; None where it does not.

    Runs at the smallest or the largest value are left out: a flow that is off, a valve at its
    stop, an instrument at the end of its range.

    Args:
        values: `[R]` in the order of the log.
    """
    probes = values[:: _FLAT_LEAST // 2]  # two neighbours of them lie in every flat run
    if not (probes[1:] == probes[:-1]).any():
        return None
    begins = np.append(0, np.flatnonzero(values[1:] != values[:-1]) + 1)
    lengths = np.diff(begins, append=len(values))
    kept = values[begins]
    flat = _flat(lengths)
    if not flat.any() or not _fluctuates(kept):
        return None
    count, rows = int(flat.sum()), int(lengths[flat].sum())
    if count > _HABIT and rows > len(values) / 2:
        return None
    flat &= (kept != kept.min()) & (kept != kept.max())
    if not flat.any():
        return None
    longest = int(np.where(flat, lengths, 0).argmax())
    return FlatRuns(
        first=int(begins[longest]),
        length=int(lengths[longest]),
        count=int(flat.sum()),
        rows=int(lengths[flat].sum()),
    )


def _flat(lengths: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which runs are flat, by the average of the others; none where the column does not move."""
    flat = lengths >= _FLAT_LEAST
    while flat.any() and not flat.all():
        average = float(lengths[~flat].mean())
        if average >= _MOVES:
            break
        fewer = flat & (lengths >= _FLAT * average)
        if fewer.sum() == flat.sum():
            return flat
        flat = fewer
    return np.zeros_like(flat)


def _fluctuates(kept: NDArray[Any]) -> bool:
    """Whether the values of successive runs go up and down as those of a sensor do."""
    changes = np.diff(kept)
    turns = (changes[1:] > 0) != (changes[:-1] > 0)
    return bool(len(turns)) and float(turns.mean()) >= _TURNS


def find_far(values: NDArray[Any], ignored: NDArray[np.bool_] | None = None) -> FarValues | None:
    """Isolated values far outside of the rest of a column; None where there are none.

    Args:
        values: `[R]` in any order.
        ignored: `[R]` rows whose values are not judged.
    """
    sample = values[:: max(1, len(values) // _SAMPLED)].astype(np.float64)
    for percentiles in _CORES:
        low, high = np.percentile(sample, percentiles)
        if low < high:
            break
    else:
        return None
    width = high - low
    least = _GAP * _NEAR * width
    if values.min() > low - least and values.max() < high + least:
        return None
    beyond = np.maximum(low - values, values - high) / width
    if ignored is not None:
        beyond[ignored] = 0
    distances = np.sort(beyond[beyond > _NEAR])
    growth = distances / np.append(_NEAR, distances[:-1])
    gaps = np.flatnonzero(growth >= _GAP)
    if not len(gaps):
        return None
    far = beyond >= distances[gaps[0]]
    found = values[far]
    return FarValues(
        first=int(far.argmax()),
        count=len(found),
        low=float(found.min()),
        high=float(found.max()),
        usual=(float(low), float(high)),
    )


def find_linear(table: NDArray[np.float64]) -> list[tuple[int, int, float, float]]:
    """Columns that are linear copies of earlier ones.

    Args:
        table: `[R, C]` rows of all columns.

    Returns:
        Index of a copy, of what it copies, and the factor and the constant that lead there.
    """
    low, high = np.percentile(table, _CORES[0], axis=0)
    near = np.maximum(low - table, table - high) <= _NEAR * (high - low)
    # Codes for "no value" stand in several columns at once, and would make copies of them.
    inner = table[(near | (low == high)).all(axis=1)]
    if len(inner) < 2:
        return []
    centre, spread = inner.mean(axis=0), inner.std(axis=0)
    usable = spread > 1e-6 * np.maximum(np.abs(centre), 1e-30)  # of what single precision resolves
    scaled = np.where(usable, inner - centre, 0.0) / np.where(usable, spread, 1.0)
    alike = scaled.T @ scaled / len(inner)
    copies = np.triu(np.abs(alike) > 1 - _RESIDUE**2 / 2, k=1)
    found = []
    for copy in np.flatnonzero(copies.any(axis=0)):
        model = int(copies[:, copy].argmax())
        factor = float(np.sign(alike[model, copy]) * spread[copy] / spread[model])
        found.append((int(copy), model, factor, float(centre[copy] - factor * centre[model])))
    return found


def _flat_sentence(column: Column) -> list[str]:
    found = find_flat(column.values)
    if found is None:
        return []
    value = float(column.values[found.first])
    more = (
        f", the longest of {found.count} such stretches with {found.rows} rows in all"
        if found.count > 1
        else ""
    )
    return [
        f"{column.place(found.first)}: {column.shown}, which changes all the time elsewhere, "
        f"stands still at {value:.6g} for {found.length} rows from here on{more}; a sensor that "
        "hangs? Leave these rows out, or the column."
    ]


def _far_sentence(column: Column, ignored: NDArray[np.bool_] | None) -> list[str]:
    found = find_far(column.values, ignored)
    if found is None:
        return []
    low, high, *usual = (
        f"{float(column.in_log_units(v)):.6g}" for v in (found.low, found.high, *found.usual)
    )
    what = low if low == high else f"{low} to {high}"
    rows = f"{found.count} rows, first" if found.count > 1 else "1 row,"
    named = f" (`na_values: [{low}]` in the schema)" if low == high else ""
    return [
        f"{column.place(found.first)}: {column.shown} is {what} in {rows} here, far outside of its "
        f"usual {usual[0]} to {usual[1]}; if that stands for no value, have it read as "
        f"missing{named}."
    ]


def _copies(columns: Sequence[Column], starts: NDArray[np.int64]) -> list[str]:
    """Warnings about features and actions that are others in another unit."""
    judged = [column for column in columns if column.role != "reward"]
    count = int(starts[-1])
    steps = np.unique(np.linspace(0, count - 1, min(count, _COMPARED)).astype(np.int64))
    rows = steps + np.searchsorted(starts, steps, side="right") - 1  # of the frames
    parts = [
        column.in_log_units(column.values[rows if column.role == "feature" else steps])
        for column in judged
    ]
    said = []
    for copy, model, factor, constant in find_linear(np.stack(parts, axis=1).astype(np.float64)):
        one, other = judged[copy], judged[model]
        sign = "-" if constant < 0 else "+"
        said.append(
            f"{one.role.capitalize()} {one.name!r} is a copy of {other.shown} in another unit: "
            f"it is about {factor:.4g} * {other.name} {sign} {abs(constant):.4g}; leave one of "
            "them out."
        )
    return said
