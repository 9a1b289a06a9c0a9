"""A DataFrame of pandas as a table of a log."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import pandas as pd
import pyarrow as pa

from components.data.imports.schema import LogError, LogSchema
from components.data.imports.tables import Batch, as_batch, check_types

__all__ = ["DataFrameTable"]

_ROWS: Final = 1 << 17  # of a batch


@dataclass(frozen=True, eq=False)
class DataFrameTable:
    """A DataFrame; its first row is row 1. A named index is a column, too."""

    frame: pd.DataFrame
    name: str = "the DataFrame"

    @property
    def columns(self) -> Sequence[str]:
        """Names of its columns."""
        return [*self._index, *map(str, self.frame.columns)]

    @property
    def _index(self) -> list[str]:
        return [str(name) for name in self.frame.index.names if name is not None]

    def batches(self, schema: LogSchema) -> Iterator[Batch]:
        """Its rows, in order."""
        if not len(self.frame):
            raise LogError(f"{self.name} has no rows; give one that has.")
        for first in range(0, len(self.frame), _ROWS):
            rows = self.frame.iloc[first : first + _ROWS]
            columns = {
                name: self._column(rows, name, first, schema.na_texts) for name in schema.columns
            }
            types = pa.schema([(name, column.type) for name, column in columns.items()])
            check_types(self.name, types, schema)
            yield as_batch(self.name, first + 1, columns, schema, opens=first == 0)

    def sample(self, rows: int) -> dict[str, Any]:
        """The first rows of all its columns."""
        head = self.frame.iloc[:rows]
        return {name: self._column(head, name, 0) for name in self.columns}

    def _column(
        self, rows: pd.DataFrame, name: str, first: int, na_texts: Sequence[str] = ()
    ) -> Any:
        """A column of some rows as an Arrow array, empty where one of `na_texts` stands.

        Raises:
            LogError: Its values are of several kinds, or of none that Arrow knows.
        """
        if name in self._index:
            values: Any = rows.index.get_level_values(name).to_series()
        else:
            values = rows.iloc[:, [str(column) for column in rows.columns].index(name)]
        if na_texts and values.dtype == object:
            values = values.where(~values.isin(na_texts))
        try:
            column = pa.Array.from_pandas(values)
        except (pa.ArrowException, TypeError, OverflowError) as error:
            raise LogError(
                f"{self.name}: column {name!r} holds values of several kinds from row {first + 1} "
                "on, not numbers; convert it, leave it out, or name texts that stand for no value "
                "in na_values."
            ) from error
        if pa.types.is_null(column.type):  # only missing values
            return column.cast(pa.float64())
        return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
