"""All rows of a log, collected batch by batch in single precision, actions scaled to [-1, 1].

What only a single cell can violate is refused here, in double precision: actions outside their
bounds, flags that are none, numbers that single precision cannot compute with. Memory is that of
the rows in single precision and of one batch.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from components.data.imports.schema import LogError, LogSchema
from components.data.imports.tables import Batch

__all__ = ["Collector", "Rows"]

_LARGEST: Final = 1e18
"""Beyond it, squares leave single precision, in which learners compute."""
_ROUNDING: Final = 1e-6  # of the range of an action: single precision rounds its bounds by less
_FIRST: Final = 1 << 16  # rows that memory is reserved for at first
_NO_TIME: Final = np.iinfo(np.int64).min


@dataclass(frozen=True)
class Rows:
    """All rows of a log.

    Attributes:
        features: `[R, F]` float32, not finite where missing.
        actions: `[R, A]` float32 in [-1, 1], not finite where missing.
        rewards: `[R]` float32 of the row, not finite where missing.
        terminal: `[R]` bool, the flag of the row.
        starts: `[R]` bool, an episode begins by the log's own words.
        intervals: `[R]` float32, time since the row before; NaN in the first row and without time.
        place: File and row of a row, for messages.
        source: File of a row, for messages.
        clipped: Number of actions that rounding had put outside of their bounds.
    """

    features: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminal: NDArray[np.bool_]
    starts: NDArray[np.bool_]
    intervals: NDArray[np.float32]
    place: Callable[[int], str]
    source: Callable[[int], str]
    clipped: int


class _Growing:
    """An array that rows are appended to. Memory that no row has reached yet is not used."""

    def __init__(self) -> None:
        self._array: NDArray[Any] = np.empty(0)
        self._count = 0

    def append(self, part: NDArray[Any]) -> None:
        """Append rows, all of one type and width."""
        needed = self._count + len(part)
        if needed > len(self._array):
            larger = np.empty((max(2 * needed, _FIRST), *part.shape[1:]), part.dtype)
            if self._count:
                larger[: self._count] = self._array[: self._count]
            self._array = larger
        self._array[self._count : needed] = part
        self._count = needed

    def whole(self) -> NDArray[Any]:
        """All rows."""
        return self._array[: self._count]


@dataclass
class Collector:
    """Collects batches into `Rows`.

    Args:
        schema: What the columns mean.
    """

    schema: LogSchema
    _arrays: dict[str, "_Growing"] = field(default_factory=dict)
    _places: list[tuple[int, str, int]] = field(default_factory=list)
    _count: int = 0
    _clipped: int = 0
    _last_time: Any = None
    _clock: tuple[str, str] = ("", "")
    _last_episode: Any = None
    _episodes: dict[Any, str] = field(default_factory=dict)

    def add(self, batch: Batch) -> None:
        """Take a batch; batches come in the order of the log.

        Raises:
            LogError: A value that cannot be.
        """
        schema = self.schema
        for name in schema.numbers:
            _refuse_huge(batch, name)
        features = np.stack([batch.numbers[name] for name in schema.features], axis=1)
        parts: dict[str, NDArray[Any]] = {
            "features": features.astype(np.float32),
            "actions": self._actions(batch),
            "rewards": self._rewards(batch, features).astype(np.float32),
            "terminal": self._flags(batch),
            "starts": self._starts(batch),
            "intervals": self._intervals(batch),
        }
        for name, part in parts.items():
            self._arrays.setdefault(name, _Growing()).append(part)
        self._places.append((self._count, batch.source, batch.first))
        self._count += batch.rows

    def finish(self) -> Rows:
        """All rows.

        Raises:
            LogError: There are none.
        """
        if not self._count:
            raise LogError("the log has no rows; give files with rows below their headers.")
        arrays: dict[str, Any] = {name: array.whole() for name, array in self._arrays.items()}
        where = _Places(tuple(self._places))
        return Rows(**arrays, place=where.place, source=where.source, clipped=self._clipped)

    def _actions(self, batch: Batch) -> NDArray[np.float32]:
        scaled = np.empty((batch.rows, len(self.schema.actions)), np.float32)
        for n, (name, (low, high)) in enumerate(self.schema.actions.items()):
            values = batch.numbers[name]
            beyond = np.maximum(low - values, values - high)
            wrong = beyond > _ROUNDING * (high - low)
            wrong &= np.isfinite(values)
            if wrong.any():
                row = int(wrong.argmax())
                more = f" ({int(wrong.sum())} such rows near it)" if wrong.sum() > 1 else ""
                raise LogError(
                    f"{batch.place(row)}: action {name!r} is {values[row]:g}, outside of its "
                    f"bounds {low:g} to {high:g}{more}; correct the bounds, their unit or the log."
                )
            self._clipped += int(((beyond > 0) & np.isfinite(values)).sum())
            unit = 2 * (values - low) / (high - low) - 1
            scaled[:, n] = np.where(np.isfinite(values), np.clip(unit, -1, 1), np.nan)
        return scaled

    def _rewards(self, batch: Batch, features: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.schema.reward:
            return batch.numbers[self.schema.reward]
        total = np.zeros(batch.rows)
        for name, weight in self.schema.weights.items():
            total += weight * features[:, self.schema.features.index(name)]
        return total

    def _flags(self, batch: Batch) -> NDArray[np.bool_]:
        name = self.schema.terminal
        if name is None:
            return np.zeros(batch.rows, np.bool_)
        flags = batch.numbers[name]
        wrong = (flags != 0) & (flags != 1)
        if wrong.any():
            row = int(wrong.argmax())
            shown = "missing" if np.isnan(flags[row]) else f"{flags[row]:g}"
            raise LogError(
                f"{batch.place(row)}: terminal {name!r} is {shown}; a flag is 0 or 1 in every row."
            )
        ended: NDArray[np.bool_] = flags == 1
        return ended

    def _starts(self, batch: Batch) -> NDArray[np.bool_]:
        starts = np.zeros(batch.rows, np.bool_)
        starts[0] = self._count == 0
        if self.schema.episode is None:
            starts[0] |= batch.opens
            return starts
        ids = batch.episode
        missing = ids.is_null(nan_is_null=True).to_numpy(zero_copy_only=False)
        if missing.any():
            raise LogError(
                f"{batch.place(int(missing.argmax()))}: episode {self.schema.episode!r} is "
                "missing; say in every row which episode it belongs to."
            )
        starts[1:] = pc.not_equal(ids[1:], ids[:-1]).to_numpy(zero_copy_only=False)
        starts[0] |= ids[0].as_py() != self._last_episode
        for row in np.flatnonzero(starts):
            episode = ids[int(row)].as_py()
            if episode in self._episodes:
                anew = self._episodes[episode] != batch.source
                remedy = (
                    f"it was in {self._episodes[episode]}, too; if every file numbers its episodes "
                    "anew, leave episode out of the schema and give gaps=split, or rename them"
                    if anew
                    else "sort the rows, or give every episode a value of its own"
                )
                raise LogError(
                    f"{batch.place(int(row))}: episode {episode!r} of column "
                    f"{self.schema.episode!r} begins again after another one; {remedy}."
                )
            self._episodes[episode] = batch.source
        self._last_episode = ids[-1].as_py()
        return starts

    def _intervals(self, batch: Batch) -> NDArray[np.float32]:
        time = batch.time
        if time is None:
            return np.full(batch.rows, np.nan, np.float32)
        if not self._clock[0]:
            self._clock = (batch.clock, batch.place(0))
        elif batch.clock != self._clock[0]:
            raise LogError(
                f"{batch.place(0)}: times {self.schema.time!r} are {_CLOCKS[batch.clock]}, but in "
                f"{self._clock[1]} {_CLOCKS[self._clock[0]]}; give all of them a time zone, or "
                "none (best UTC)."
            )
        missing = time == _NO_TIME if time.dtype == np.int64 else ~np.isfinite(time)
        if missing.any():
            raise LogError(
                f"{batch.place(int(missing.argmax()))}: time {self.schema.time!r} is missing; "
                "repair it or leave the row out."
            )
        before = time[:1] if self._last_time is None else self._last_time
        passed = np.diff(time, prepend=before).astype(np.float64)
        if time.dtype == np.int64:
            passed /= 1e9  # nanoseconds
        if self._last_time is None:
            passed[0] = np.nan
        self._last_time = time[-1:]
        return passed.astype(np.float32)


_CLOCKS: Final[Mapping[str, str]] = {
    "number": "numbers",
    "naive": "time stamps without a time zone",
    "zoned": "time stamps with a time zone",
}


def _refuse_huge(batch: Batch, name: str) -> None:
    values = np.abs(batch.numbers[name])
    wrong = (values > _LARGEST) & np.isfinite(values)
    if wrong.any():
        row = int(wrong.argmax())
        raise LogError(
            f"{batch.place(row)}: {name!r} is {batch.numbers[name][row]:g}, too large to compute "
            "with; name it in na_values if it stands for no value."
        )


@dataclass(frozen=True)
class _Places:
    """Tells file and row of a row of the whole log.

    Attributes:
        batches: First row, file and row there of each batch.
    """

    batches: Sequence[tuple[int, str, int]]

    def place(self, row: int) -> str:
        """File and row."""
        begin, source, first = self._batch(row)
        return f"{source}, row {first + row - begin}"

    def source(self, row: int) -> str:
        """The file."""
        return self._batch(row)[1]

    def _batch(self, row: int) -> tuple[int, str, int]:
        return self.batches[bisect_right(self.batches, row, key=lambda batch: batch[0]) - 1]
