"""The first draft of a schema, guessed from the columns of a log and a sample of their values."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from components.data.imports.csv_table import CsvTable
from components.data.imports.minari_table import MinariTable
from components.data.imports.schema import LogError
from components.data.imports.tables import Table, times_of
from components.data.imports.times import guess_format, parse_times

__all__ = ["draft_schema"]

_SAMPLE: Final = 20_000  # rows
_SINGLE: Final = ("time", "episode", "reward", "terminal")
"""Roles that one column has at most."""
_CODES: Final = 5  # different texts among numbers that may stand for no value
_TIME: Final = re.compile(r"(time|timestamp|datetime|date|zeit|t)", re.IGNORECASE)
_EPISODE: Final = re.compile(
    r"(episode|run|batch|trial|trajectory|charge|heat|shift|campaign)(_?(id|nr|no))?", re.I
)
_REWARD: Final = re.compile(r"(reward|rewards|profit|return|score)", re.IGNORECASE)
_TERMINAL: Final = re.compile(r"(terminal|terminals|terminated|done|failed|tripped|fault)", re.I)
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_ACTION: Final = re.compile(r"(action|act|control|ctrl|u|set|cmd|command)([ _.\-]?.*)", re.I)


@dataclass(frozen=True)
class _Guess:
    """What a column seems to be, and the values it has in the sample."""

    name: str
    role: str
    values: Any
    about: str
    time_format: str | None = None
    na_texts: tuple[str, ...] = ()


def draft_schema(tables: Sequence[Table], name: str) -> str:
    """A schema in YAML with comments; what cannot be guessed is to be filled in.

    Args:
        tables: Of the log; the first one is looked at.
        name: Of the dataset.

    Raises:
        LogError: The first table cannot be read.
    """
    table = tables[0]
    twice = [column for column, count in Counter(table.columns).items() if count > 1]
    if twice:
        raise LogError(f"{table.name}, row 1: column {twice[0]!r} is there twice; rename one.")
    sample = table.sample(_SAMPLE)
    if isinstance(table, CsvTable) and _decimal_commas(table, sample):
        table = replace(table, format=replace(table.format, decimal=","))
        sample = table.sample(_SAMPLE)
    if not sample or not len(next(iter(sample.values()))):
        raise LogError(f"{table.name} has no rows; give a file that has.")
    decimal = table.format.decimal if isinstance(table, CsvTable) else "."
    guesses = [_guess(column, values, decimal) for column, values in sample.items()]
    by_role: dict[str, list[_Guess]] = {}
    for guess in guesses:
        by_role.setdefault(guess.role, []).append(guess)
    single = {role: next(iter(by_role.get(role, ())), None) for role in _SINGLE}
    features = [guess for guess in guesses if guess.role == "feature"]
    features += [g for role in _SINGLE for g in by_role.get(role, [])[1:]]
    rows = len(next(iter(sample.values())))
    minari = table if isinstance(table, MinariTable) else None
    lines = [
        f"# Draft of the schema of {name}, guessed from the first {rows} rows of {table.name}.",
        "# Correct it: every column has one role, and those that are not named are not used.",
        "",
        "features: # the state, in its own units",
        *(f"  - {_quoted(g.name)} # {g.about}" for g in features),
        *([] if features else ["  # - NAME"]),
        *_left_out(by_role.get("unused", [])),
        "",
        "actions: # what the controller set, with the smallest and the largest value possible",
        *(_bounds(g, n, minari) for n, g in enumerate(by_role.get("action", []))),
        *([] if "action" in by_role else ["  # NAME: [0, 100]"]),
        "",
        *_outcome_lines(single["reward"], single["terminal"], minari is not None),
        "",
        *_time_lines(single["episode"], single["time"]),
        "",
        "history: 10 # newest rows that a policy sees: enough to tell the state",
        "discount: 0.97 # per row",
        "# controller: operators # who or what set the actions",
        "",
        "# Features that follow exactly from an action, if every action has one:",
        "#   next = clip(keep * old + gain * action), in the log's units",
        "# known:",
        "#   bounds: [0, 100]",
        "#   features:",
        "#     VALVE: {action: VALVE_CHANGE, gain: 1, keep: 1}",
    ]
    if isinstance(table, CsvTable):
        form = table.format
        lines += [
            "",
            f"delimiter: {_quoted(form.delimiter)}",
            f"decimal: {_quoted(form.decimal)}",
            f"encoding: {form.encoding}",
        ]
    texts = sorted({text for guess in guesses for text in guess.na_texts})
    if texts:
        listing = ", ".join(map(_quoted, texts))
        lines += ["", f"na_values: [{listing}] # found among numbers; they stand for no value"]
    return "\n".join(lines) + "\n"


def _guess(name: str, column: Any, decimal: str) -> _Guess:
    kind = column.type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _guess_text(name, column, decimal)
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    if pa.types.is_temporal(kind) or (number and _TIME.fullmatch(name)):
        return _Guess(name, "time", column, str(kind))
    if _EPISODE.fullmatch(name):
        return _Guess(name, "episode", column, str(kind))
    if _TERMINAL.fullmatch(name) and (number or pa.types.is_boolean(kind)):
        return _Guess(name, "terminal", column, str(kind))
    if not (number or pa.types.is_boolean(kind)):
        about = "no values" if pa.types.is_null(kind) else f"neither numbers nor text, but {kind}"
        return _Guess(name, "unused", column, about)
    return _guess_numbers(name, column)


def _guess_text(name: str, column: Any, decimal: str) -> _Guess:
    """A column of text: episodes, times of an own format, or numbers with some texts among them."""
    if _EPISODE.fullmatch(name):
        return _Guess(name, "episode", column, "text")
    texts = [text.strip() for text in column.to_pylist() if text is not None]
    # The month is only known to come first where a second number is a day.
    for form in sorted({guess_format(text) or "" for text in texts}, reverse=True):
        if not form:
            break
        try:
            times = parse_times(column, form, name, str)
        except LogError:
            continue
        return _Guess(name, "time", times, "text", time_format=form)
    odd = Counter(text for text in texts if not _NUMBER.fullmatch(text.replace(decimal, ".")))
    if 0 < odd.total() < len(texts) / 2 and len(odd) <= _CODES:
        numbers = [text.replace(decimal, ".") for text in texts if text not in odd]
        missing: list[str | None] = [None] * (len(column) - len(numbers))
        guess = _guess_numbers(name, pa.array([*numbers, *missing]).cast(pa.float64()))
        return replace(guess, na_texts=tuple(odd))
    return _Guess(name, "unused", column, f"text, e.g. {texts[0]!r}" if texts else "no values")


def _guess_numbers(name: str, column: Any) -> _Guess:
    values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    finite = values[np.isfinite(values)]
    about = f"{finite.min():g} to {finite.max():g}" if len(finite) else "no values"
    if len(finite) < len(values):
        about += f", {len(values) - len(finite)} missing"
    for role, pattern in (("reward", _REWARD), ("action", _ACTION)):
        if pattern.fullmatch(name):
            return _Guess(name, role, finite, about)
    if len(finite) and (finite == finite[0]).all():
        return _Guess(name, "unused", finite, f"always {finite[0]:g} in these rows")
    return _Guess(name, "feature", finite, about)


def _decimal_commas(table: CsvTable, sample: dict[str, Any]) -> bool:
    """Whether a column holds nothing but numbers with a comma, which does not separate columns."""
    if table.format.delimiter == "," or table.format.decimal != ".":
        return False
    for column in sample.values():
        if pa.types.is_string(column.type):
            texts = [text.strip() for text in column.to_pylist() if text is not None]
            numbers = [text for text in texts if _NUMBER.fullmatch(text.replace(",", ".", 1))]
            if len(numbers) > len(texts) / 2 and any("," in text for text in numbers):
                return True
    return False


def _left_out(unused: Sequence[_Guess]) -> list[str]:
    """Comments about the columns that no role was found for."""
    if not unused:
        return []
    return ["# Not used:", *(f"#   {_quoted(g.name)}: {_line(g.about)}" for g in unused)]


def _line(text: str) -> str:
    return " ".join(text.split())[:80]


def _bounds(guess: _Guess, number: int, minari: MinariTable | None) -> str:
    if minari is not None:
        low, high = minari.bounds[number]
        if np.isfinite([low, high]).all():
            return f"  {_quoted(guess.name)}: [{low:g}, {high:g}] # of its space"
    least, most = (guess.values.min(), guess.values.max()) if len(guess.values) else (-1.0, 1.0)
    return f"  {_quoted(guess.name)}: [{least:g}, {most:g}] # as found, not as possible"


def _outcome_lines(reward: _Guess | None, terminal: _Guess | None, gym: bool) -> list[str]:
    lines = ["# The reward is a column, or a weighted sum of features:"]
    if reward is not None:
        lines += [
            f"reward: {_quoted(reward.name)} # {reward.about}",
            "# reward_weights: {NAME: -1}",
        ]
    else:
        lines += ["# reward: NAME", "reward_weights: # {NAME: -1.0}"]
    named = f"terminal: {_quoted(terminal.name)}" if terminal else "# terminal: NAME"
    row = "same" if gym else "FILL_IN # after or same"
    lines += [
        f"{named} # 1 where an episode ended for good; all others were merely cut",
        "# Reward and terminal of an action stand in the row `after` it, with the state that it",
        "# led to (the log of a plant), or in the `same` row (Gymnasium, D4RL):",
        f"{'' if reward or terminal else '# '}outcome_row: {row}",
    ]
    return lines


def _time_lines(episode: _Guess | None, time: _Guess | None) -> list[str]:
    lines = [
        f"episode: {_quoted(episode.name)} # its value changes where an episode begins"
        if episode
        else "# episode: NAME # without it, every file is one",
        "# episode_rows: 1000 # longer episodes are cut",
    ]
    if time is None:
        return [*lines, "# time: NAME", "# sampling: 1"]
    stamps, clock = times_of(time.values)
    passed = np.diff(stamps).astype(np.float64) / (1 if clock == "number" else 1e9)
    usual = float(np.median(passed)) if len(passed) else 1.0
    unit = "in the unit of time" if clock == "number" else "seconds"
    form = time.time_format
    return [
        *lines,
        f"time: {_quoted(time.name)}",
        *([f"time_format: '{form}' # is the day first, or the month?"] if form else []),
        f"sampling: {usual:g} # {unit}, the usual interval of its rows",
    ]


def _quoted(text: str) -> str:
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_\-/]*", text)
    odd = text.lower() in ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
    return text if plain and not odd else "'" + text.replace("'", "''") + "'"
