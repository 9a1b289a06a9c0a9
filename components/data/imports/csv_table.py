"""CSV files, in batches; when one cannot be read, the cell that is wrong is searched and named.

Arrow converts whole blocks and says little about a cell that is no number. Only then is the file
read again, as text, by :func:`_explain`.
"""

import codecs
import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.csv as pacsv

from components.data.imports.schema import LogError, LogSchema
from components.data.imports.tables import Batch, as_batch
from components.data.imports.times import guess_format

__all__ = ["CsvFormat", "CsvTable"]

_BLOCK: Final = 8 << 20  # bytes read together
_HEAD: Final = 1 << 20  # bytes in which the header ends
_ZONE: Final = re.compile(r"\d(Z|[+-]\d\d:?\d\d)$")
_THOUSANDS: Final = re.compile(r"[+-]?\d{1,3}([,.'’_ \u00a0\u202f]\d{3})+([.,]\d+)?")
_COMMA: Final = re.compile(r"[+-]?\d*,\d+")
_UNIT: Final = re.compile(r"[+-]?[\d.,]+([eE][+-]?\d+)?\s*[A-Za-zµΩ°%‰$€].*")
_NO_VALUE: Final[Sequence[str]] = pacsv.ConvertOptions().null_values
"""What stands for no value in any file, such as NaN."""
_FLAGS: Final = ("0", "1", "true", "True", "TRUE", "false", "False", "FALSE")


@dataclass(frozen=True)
class CsvFormat:
    """How a CSV file is written."""

    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    na_texts: tuple[str, ...] = ()

    @classmethod
    def of(cls, schema: LogSchema) -> "CsvFormat":
        """What a schema says about it."""
        return cls(schema.delimiter, schema.decimal, schema.encoding, schema.na_texts)


@dataclass(frozen=True)
class CsvTable:
    """A CSV file, plain or compressed; its header is row 1."""

    path: Path
    name: str
    format: CsvFormat

    @cached_property
    def columns(self) -> Sequence[str]:
        """Names of its columns.

        Raises:
            LogError: The file is empty, or its header cannot be read.
        """
        try:
            with pa.input_stream(str(self.path), compression="detect") as stream:
                head: bytes = stream.read(_HEAD)
        except pa.ArrowException as error:
            raise LogError(f"{self.name} cannot be read ({error}); store it again.") from error
        if not head.strip():
            raise LogError(f"{self.name} is empty; give a file with a header and rows.")
        if head[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            raise LogError(
                f"{self.name}, row 1, is UTF-16, not {self.format.encoding}; convert the file to "
                "UTF-8."
            )
        first, *below = re.split(rb"[\r\n]+", head.strip(), maxsplit=1)
        if not below:
            raise LogError(
                f"{self.name} has no rows below row 1; give a file with a header and rows."
            )
        try:
            text = first.decode(self.format.encoding).removeprefix("\ufeff")
        except UnicodeDecodeError as error:
            raise LogError(
                f"{self.name}, row 1, is not {self.format.encoding} ({error.object[error.start]:#x}"
                f" in byte {error.start + 1}); convert the file, or give encoding, e.g. latin-1."
            ) from error
        except LookupError as error:
            raise LogError(
                f"encoding {self.format.encoding!r} is not known; give e.g. latin-1."
            ) from error
        try:
            names = next(csv.reader(io.StringIO(text), delimiter=self.format.delimiter))
        except csv.Error as error:
            raise LogError(f"{self.name}, row 1, is no header ({error}); correct it.") from error
        self._check_delimiter(names, text)
        return names

    def _check_delimiter(self, names: Sequence[str], header: str) -> None:
        others = [d for d in ";\t|," if d != self.format.delimiter and d in header]
        if len(names) == 1 and others:
            raise LogError(
                f"{self.name} has the one column {names[0]!r} in row 1; if {others[0]!r} separates "
                f"its columns, give `delimiter: {others[0]!r}` in the schema."
            )

    def batches(self, schema: LogSchema) -> Iterator[Batch]:
        """Its rows, in order."""
        types: dict[str, Any] = dict.fromkeys(schema.numbers, pa.float64())
        if schema.terminal:
            types[schema.terminal] = pa.bool_()
        if schema.episode:
            types[schema.episode] = pa.string()
        if schema.time:
            types[schema.time] = pa.string() if schema.time_format else self._time_type(schema.time)
        row = 2
        try:
            for batch in self._read(types, _BLOCK):
                if batch.num_rows:
                    columns = {name: batch.column(name) for name in schema.columns}
                    yield as_batch(self.name, row, columns, schema, opens=row == 2)
                    row += batch.num_rows
        except pa.ArrowException as error:
            raise self._explain(types) from error

    def sample(self, rows: int) -> dict[str, Any]:
        """The first rows of all its columns, with the types that they seem to have."""
        convert = self._convert()
        try:
            with self._opened(convert, block=_HEAD) as reader:
                for batch in reader:
                    head = batch[:rows]
                    return dict(zip(head.schema.names, head.columns, strict=True))
        except pa.ArrowException as error:
            raise self._explain(dict.fromkeys(self.columns, pa.string())) from error
        return {}

    def _opened(self, convert: Any, *, block: int, threads: bool = True, **parse: Any) -> Any:
        encoding = codecs.lookup(self.format.encoding).name
        return pacsv.open_csv(
            self.path,
            read_options=pacsv.ReadOptions(
                block_size=block,
                encoding="utf8" if encoding == "utf-8" else encoding,
                use_threads=threads,
            ),
            parse_options=pacsv.ParseOptions(delimiter=self.format.delimiter, **parse),
            convert_options=convert,
        )

    def _convert(self, **options: Any) -> Any:
        """How cells become values."""
        return pacsv.ConvertOptions(
            strings_can_be_null=True,
            decimal_point=self.format.decimal,
            null_values=[*_NO_VALUE, *self.format.na_texts],
            **options,
        )

    def _read(self, types: dict[str, Any], block: int, **parse: Any) -> Iterator[Any]:
        convert = self._convert(include_columns=list(types), column_types=types)
        # Rows are numbered for the handler of invalid ones by a single thread alone.
        with self._opened(convert, block=block, threads=not parse, **parse) as reader:
            yield from reader

    def _time_type(self, name: str) -> Any:
        """The type of a column of time, by its first values."""
        found: Any = pa.null()
        try:
            with self._opened(self._convert(include_columns=[name]), block=1 << 16) as reader:
                found = reader.schema.field(0).type
        except pa.ArrowException:  # the whole reading explains it
            return pa.float64()
        if pa.types.is_timestamp(found) or pa.types.is_date(found):
            return pa.timestamp("ns", tz=getattr(found, "tz", None))
        if pa.types.is_string(found):
            first = self.sample(1)[name][0].as_py() or ""
            number = _wrong_number(first, self.format.decimal) is None
            raise self._explain({name: pa.float64() if number else pa.timestamp("ns")})
        return pa.float64()

    def _explain(self, types: dict[str, Any]) -> LogError:
        """Which cell is wrong, and what about it."""
        odd: list[Any] = []

        def kept(row: Any) -> str:
            odd.append(row)
            return "error"

        row = 2
        texts = dict.fromkeys(types, pa.binary())
        first: dict[str, str] = {}
        try:
            for batch in self._read(texts, 1 << 20, invalid_row_handler=kept):
                for name, kind in types.items():
                    fault = self._first_fault(name, kind, batch.column(name), row, first)
                    if fault is not None:
                        return fault
                row += batch.num_rows
        except pa.ArrowException as error:
            if odd:
                wrong = odd[0]
                near = wrong.number or f"after {row - 1}"
                return LogError(
                    f"{self.name}, row {near}, has {wrong.actual_columns} columns, not "
                    f"{wrong.expected_columns} ({wrong.text[:60]!r}); thousands separators or the "
                    "delimiter itself in a cell need quotation marks."
                )
            return LogError(f"{self.name} cannot be read after row {row - 1} ({error}).")
        return LogError(f"{self.name} cannot be read; its columns do not hold what they should.")

    def _first_fault(
        self, name: str, kind: Any, cells: Any, row: int, first: dict[str, str]
    ) -> LogError | None:
        for number, cell in enumerate(cells.to_pylist(), start=row):
            if cell is None:
                continue
            where = f"{self.name}, row {number}: {name!r}"
            try:
                text = cell.decode("utf-8").strip()  # Arrow has converted other encodings into it
            except UnicodeDecodeError:
                return LogError(
                    f"{where} holds {cell!r}, which is not UTF-8; convert the file, or give "
                    "encoding, e.g. latin-1."
                )
            before = first.setdefault(name, text)
            if pa.types.is_timestamp(kind):
                said = _wrong_time(text, before)
            elif pa.types.is_boolean(kind):
                said = None if text in _FLAGS else f"is {text!r}; a flag is 0 or 1."
            elif pa.types.is_floating(kind):
                said = _wrong_number(text, self.format.decimal)
            else:
                said = None
            if said is not None:
                return LogError(f"{where} {said}")
        return None


def _wrong_time(text: str, first: str) -> str | None:
    zoned, expected = (bool(_ZONE.search(value)) for value in (text, first))
    if zoned != expected:
        return (
            f"is {text!r}, but {first!r} before it; give all times a time zone, or none (best UTC)."
        )
    kind = pa.timestamp("ns", tz="UTC" if zoned else None)
    try:
        pa.array([text]).cast(kind)
    except pa.ArrowException:
        form = guess_format(text)
        if form is not None:
            return f"is {text!r}, which is no ISO time; give `time_format: '{form}'` in the schema."
        return (
            f"is {text!r}, which is no time; write e.g. 2026-01-31 12:00:00, or numbers, or give "
            "time_format in the schema."
        )
    return None


def _wrong_number(text: str, decimal: str) -> str | None:
    try:
        pa.array([text.replace(decimal, ".")]).cast(pa.float64())
    except pa.ArrowException:
        pass
    else:
        if decimal == "." or "." not in text:
            return None
    if text.lower() in ("true", "false"):
        return f"is {text!r}; write 1 and 0."
    if decimal == "." and _COMMA.fullmatch(text) and not _THOUSANDS.fullmatch(text):
        return f"is {text!r}; if the comma is a decimal point, give `decimal: ','` in the schema."
    if _THOUSANDS.fullmatch(text):
        return (
            f"is {text!r}, which seems to have thousands separators; write plain numbers, or give "
            "`decimal` in the schema."
        )
    if _UNIT.fullmatch(text):
        return f"is {text!r}, a number with a unit; write numbers alone, all in one unit."
    return (
        f"is {text!r}, which is no number; if it stands for no value, give "
        f"`na_values: [{text!r}]` in the schema."
    )
