"""Times that are written in a format of their own."""

import re
from collections.abc import Callable
from typing import Any, Final

import pyarrow as pa

from components.data.imports.schema import LogError

__all__ = ["guess_format", "parse_times"]

_DATE: Final = re.compile(
    r"(?P<one>\d{1,2})(?P<sign>[./-])(?P<two>\d{1,2})(?P=sign)(?P<year>\d{4}|\d{2})"
    r"(?P<gap>[ T]?)(?P<clock>\d{1,2}:\d\d)?(?P<seconds>:\d\d)?(?P<part>\.\d+)?"
)


def guess_format(text: str) -> str | None:
    """The format of a date such as `31.01.2026 12:00:00`, the day first unless that cannot be.

    Args:
        text: A time as it is written.

    Returns:
        As `strptime` reads it; None where nothing is known.
    """
    found = _DATE.fullmatch(text)
    if found is None or (not found["clock"] and (found["gap"] or found["seconds"])):
        return None
    days = ("%m", "%d") if int(found["two"]) > 12 else ("%d", "%m")
    form = found["sign"].join((*days, "%Y" if len(found["year"]) == 4 else "%y"))
    if found["clock"]:
        form += found["gap"] + "%H:%M"
    return form + (":%S" if found["seconds"] else "") + (".%f" if found["part"] else "")


def parse_times(column: Any, form: str, name: str, place: Callable[[int], str]) -> Any:
    """Time stamps of a column of text or whole numbers; others are returned as they are.

    Args:
        column: Of Arrow.
        form: Format as `strptime` reads it.
        name: Of the column.
        place: File and row of one of its rows.

    Raises:
        LogError: A text that has another format, or no such format.
    """
    import pandas as pd  # slow to import, and seldom needed

    kind = column.type
    if not (
        pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_integer(kind)
    ):
        return column
    texts = column.cast(pa.string()).to_pandas().str.strip()
    zoned = "%z" in form or "%Z" in form
    try:
        times = pd.to_datetime(texts, format=form, errors="coerce", utc=zoned)
    except ValueError as error:
        raise LogError(f"time_format {form!r} cannot be read ({error}); correct it.") from error
    wrong = (times.isna() & texts.notna() & (texts != "")).to_numpy()
    if wrong.any():
        row = int(wrong.argmax())
        raise LogError(
            f"{place(row)}: {name!r} is {texts[row]!r}, which is no time of time_format {form!r}; "
            "correct the format or the log."
        )
    return pa.Array.from_pandas(times, type=pa.timestamp("ns", tz="UTC" if zoned else None))
