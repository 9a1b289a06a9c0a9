"""Files as batches of rows: what every kind of table offers, and Parquet.

A table knows its columns before any row is read, and hands out its rows in batches of numpy
arrays, so that a log of any length is read in little memory.
"""

import difflib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from components.data.imports.schema import LogError, LogSchema
from components.data.imports.times import parse_times

__all__ = ["Batch", "ParquetTable", "Table", "as_batch", "check_columns", "check_types", "times_of"]

_ROWS = 1 << 17  # of a batch of Parquet


@dataclass(frozen=True)
class Batch:
    """Some rows of one file.

    Attributes:
        source: What the file is called in messages.
        first: Number of the first row, as people count it.
        numbers: `[R]` float64 of each column of numbers and the terminal flag, NaN where missing.
        time: `[R]` nanoseconds (int64) of time stamps, or numbers (float64); None without.
        clock: Kind of the time: `number`, `naive` or `zoned` time stamps; empty without.
        episode: `[R]` episode of each row; None without such a column.
        opens: Whether the file begins with this batch.
    """

    source: str
    first: int
    numbers: Mapping[str, NDArray[np.float64]]
    time: NDArray[Any] | None
    clock: str
    episode: Any
    opens: bool

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.numbers.values())))

    def place(self, row: int) -> str:
        """File and row of a row of the batch."""
        return f"{self.source}, row {self.first + row}"


class Table(Protocol):
    """A file, or something else with columns and rows."""

    @property
    def name(self) -> str:
        """What it is called in messages."""

    @property
    def columns(self) -> Sequence[str]:
        """Names of its columns, whether the schema names them or not."""

    def batches(self, schema: LogSchema) -> Iterator[Batch]:
        """Its rows, in order.

        Raises:
            LogError: Something in it cannot be read.
        """

    def sample(self, rows: int) -> dict[str, Any]:
        """The first rows of all its columns, at most so many, as Arrow arrays.

        Raises:
            LogError: They cannot be read.
        """


def check_columns(table: Table, schema: LogSchema) -> None:
    """Refuse a table whose columns are not those of the schema.

    Raises:
        LogError: A column that the schema names is missing or there twice.
    """
    counts = Counter(table.columns)
    for name in schema.columns:
        if counts[name] > 1:
            raise LogError(
                f"{table.name} has {counts[name]} columns of the name {name!r}; rename all but one."
            )
        if not counts[name]:
            close = difflib.get_close_matches(name, list(counts), n=1)
            meant = f"; did you mean {close[0]!r}?" if close else "."
            some = [*list(counts)[:20], *(["..."] if len(counts) > 20 else [])]
            raise LogError(f"{table.name} has no column {name!r}; it has {', '.join(some)}{meant}")


def _numbers_of(column: Any) -> NDArray[np.float64]:
    """A column of numbers or flags as float64, NaN where missing."""
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    values: NDArray[np.float64] = column.cast(pa.float64(), safe=False).to_numpy(
        zero_copy_only=False
    )
    return values


def times_of(column: Any) -> tuple[NDArray[Any], str]:
    """A column of time, and which kind it is; missing ones are NaN or NaT as int64.

    Raises:
        pa.ArrowInvalid: It is no time.
    """
    kind = column.type
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return _numbers_of(column), "number"
    clock = "zoned" if getattr(kind, "tz", None) else "naive"
    stamps = column.cast(pa.timestamp("ns", tz=getattr(kind, "tz", None)))
    return stamps.cast(pa.int64()).fill_null(np.iinfo(np.int64).min).to_numpy(), clock


def as_batch(
    source: str, first: int, columns: Mapping[str, Any], schema: LogSchema, *, opens: bool
) -> Batch:
    """A batch of Arrow columns."""
    names = (*schema.numbers, *([schema.terminal] if schema.terminal else []))
    time, clock = None, ""
    if schema.time:
        column = columns[schema.time]
        if schema.time_format:
            column = parse_times(
                column, schema.time_format, schema.time, lambda row: f"{source}, row {first + row}"
            )
        time, clock = times_of(column)
    numbers = {name: _numbers_of(columns[name]) for name in names}
    if schema.na_numbers:
        numbers = {
            name: np.where(np.isin(values, schema.na_numbers), np.nan, values)
            for name, values in numbers.items()
        }
    return Batch(
        source=source,
        first=first,
        numbers=numbers,
        time=time,
        clock=clock,
        episode=columns[schema.episode] if schema.episode else None,
        opens=opens,
    )


def check_types(source: str, types: Any, schema: LogSchema) -> None:
    """Refuse columns that hold neither numbers nor time.

    Args:
        source: What the table is called in messages.
        types: Its Arrow schema.
        schema: What its columns mean.

    Raises:
        LogError: Naming the column.
    """
    for name in schema.columns:
        kind = types.field(name).type
        number = (
            pa.types.is_integer(kind)
            or pa.types.is_floating(kind)
            or pa.types.is_decimal(kind)
            or pa.types.is_boolean(kind)
        )
        if name == schema.episode:
            continue
        if name == schema.time:
            time = pa.types.is_timestamp(kind) or pa.types.is_date(kind)
            text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
            if not (number or time or (text and schema.time_format)):
                raise LogError(
                    f"{source}: column {name!r} holds {kind} from row 1 on, not time; store "
                    "it as time stamps or numbers, or give time_format in the schema."
                )
        elif not number:
            raise LogError(
                f"{source}: column {name!r} holds {kind} from row 1 on, not numbers; "
                "convert it or leave it out."
            )


@dataclass(frozen=True)
class ParquetTable:
    """A Parquet file; its first row is row 1."""

    path: Path
    name: str

    @property
    def columns(self) -> Sequence[str]:
        """Names of its columns."""
        return list(self._file().schema_arrow.names)

    def _file(self) -> Any:
        try:
            # Without the buffer one row group is held at a time, not the whole file.
            return pq.ParquetFile(self.path, pre_buffer=False, buffer_size=1 << 20)
        except pa.ArrowException as error:
            raise LogError(
                f"{self.name} cannot be read as Parquet ({_reason(error)}); store it again."
            ) from error

    def batches(self, schema: LogSchema) -> Iterator[Batch]:
        """Its rows, in order."""
        file = self._file()
        check_types(self.name, file.schema_arrow, schema)
        row = 1
        try:
            for batch in file.iter_batches(batch_size=_ROWS, columns=list(schema.columns)):
                if batch.num_rows:
                    columns = {name: batch.column(name) for name in schema.columns}
                    yield as_batch(self.name, row, columns, schema, opens=row == 1)
                    row += batch.num_rows
        except (pa.ArrowException, OSError) as error:
            raise LogError(
                f"{self.name} cannot be read from row {row} on ({_reason(error)}); store it again."
            ) from error

    def sample(self, rows: int) -> dict[str, Any]:
        """The first rows of all its columns."""
        for batch in self._file().iter_batches(batch_size=rows):
            return dict(zip(batch.schema.names, batch.columns, strict=True))
        return {}


def _reason(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
