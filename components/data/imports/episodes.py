"""Rows become episodes: time is checked, what is missing is refused or repaired, all is counted.

With R rows an episode has R - 1 steps, whose last state stands in the last row. Unused are
therefore the action of the last row, and the reward of the last row (where it stands in the row of
its action) or of the first one (where it stands in the row after it). They may be missing.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.imports.rows import Rows
from components.data.imports.schema import LogError, LogSchema, Repairs

__all__ = ["Episodes", "find_episodes"]

_SUMMER: Final = 3600.0  # seconds by which clocks change


@dataclass
class Episodes:
    """Where the episodes of a log are and what was done to get them.

    Attributes:
        begins: `[E]` first row of each episode that is kept.
        ends: `[E]` row after its last.
        repeated: `[E]` its last step is kept although the state after it was not recorded.
        notes: Sentences about what was dropped, cut or filled in.
    """

    begins: NDArray[np.int64]
    ends: NDArray[np.int64]
    repeated: NDArray[np.bool_]
    notes: list[str] = field(default_factory=list)


def find_episodes(rows: Rows, schema: LogSchema, repairs: Repairs) -> Episodes:
    """Cut rows into episodes.

    Args:
        rows: All rows; missing values are filled in where `repairs` says so.
        schema: What the columns mean.
        repairs: What to do about a log that is not whole.

    Raises:
        LogError: A value is missing, time jumps, an episode ends in its middle or has no step.
    """
    notes: list[str] = []
    starts = rows.starts.copy()
    if schema.episode is None:
        starts[1:] |= rows.terminal[:-1]
    _check_time(rows, starts, schema, repairs, notes)
    _cut(starts, schema.episode_rows, notes)
    begins = np.flatnonzero(starts)
    ends = np.append(begins[1:], len(starts))
    _check_ends(rows, ends, schema)
    keep = np.ones(len(begins), np.bool_)
    _repair_missing(rows, (begins, ends), keep, schema, repairs, notes)
    found = _with_ends(rows, begins[keep], ends[keep], schema, notes)
    return _long_enough(rows, found, repairs)


def _check_time(
    rows: Rows, starts: NDArray[np.bool_], schema: LogSchema, repairs: Repairs, notes: list[str]
) -> None:
    if schema.sampling is None or schema.time is None:
        return
    passed, wanted = rows.intervals, schema.sampling
    odd = ~starts & ~(np.abs(passed - wanted) <= max(schema.jitter, 1e-5) * wanted)
    gaps = odd & (passed > wanted)
    if repairs.gaps == "split" and gaps.any():
        starts |= gaps
        notes.append(f"{int(gaps.sum())} gaps in time begin a new episode each.")
        odd &= ~gaps
    if not odd.any():
        return
    row = int(odd.argmax())
    step = float(passed[row])
    where = f"{rows.place(row)}: time {schema.time!r}"
    count = int(odd.sum())
    more = f" ({count} such rows)" if count > 1 else ""
    clocks = abs(abs(step - wanted) - _SUMMER) <= schema.jitter * wanted
    hint = " (a change to summer time? give times in UTC)" if clocks else ""
    if step == 0:
        raise LogError(
            f"{where} is that of the row before{more}; remove the duplicates, or name the column "
            "of episodes."
        )
    if step < 0:
        raise LogError(
            f"{where} goes back by {-step:g}{hint}{more}; sort the rows, or name the column of "
            "episodes."
        )
    if step > wanted:
        raise LogError(
            f"{where} is {step:g} after the row before, a gap at a sampling of {wanted:g}{hint}"
            f"{more}; give gaps=split to begin an episode after each, or correct sampling."
        )
    raise LogError(
        f"{where} is only {step:g} after the row before at a sampling of {wanted:g}{more}; correct "
        "sampling or jitter, or log at one interval."
    )


def _cut(starts: NDArray[np.bool_], longest: int | None, notes: list[str]) -> None:
    """Let episodes begin anew after so many rows."""
    if longest is None:
        return
    row = np.arange(len(starts))
    first = np.maximum.accumulate(np.where(starts, row, 0))
    cut = ~starts & ((row - first) % longest == 0)
    cut &= ~np.append(starts[1:], True)  # a single row at the end stays with those before it
    starts |= cut
    cuts = int(cut.sum())
    if cuts:
        notes.append(
            f"{cuts} cuts after {longest} rows begin a new episode each; the step across a cut is "
            "lost."
        )


def _check_ends(rows: Rows, ends: NDArray[np.int64], schema: LogSchema) -> None:
    """Refuse terminal rows in the middle of an episode."""
    allowed = np.zeros(len(rows.terminal), np.bool_)
    allowed[ends - 1] = True
    if schema.same_row:  # the last row may hold nothing but the terminal state
        allowed[np.maximum(ends - 2, 0)] = True
    wrong = rows.terminal & ~allowed
    if wrong.any():
        row = int(wrong.argmax())
        raise LogError(
            f"{rows.place(row)}: terminal {schema.terminal!r} is set, but its episode goes on "
            f"({int(wrong.sum())} such rows); let another episode begin after it, or correct "
            "outcome_row."
        )


def _repair_missing(
    rows: Rows,
    bounds: tuple[NDArray[np.int64], NDArray[np.int64]],
    keep: NDArray[np.bool_],
    schema: LogSchema,
    repairs: Repairs,
    notes: list[str],
) -> None:
    """Refuse missing values, fill them in, or mark their episodes as dropped in `keep`."""
    begins, ends = bounds
    filled: dict[str, int] = {}
    first: tuple[int, str, float] | None = None
    count = 0
    for name, values, unused in _columns(rows, begins, ends, schema):
        wrong = ~np.isfinite(values)
        if unused is not None:
            wrong[unused] = False
        found = np.flatnonzero(wrong)
        if not len(found):
            continue
        count += len(found)
        if repairs.missing == "drop_episode":
            keep[np.searchsorted(begins, found, side="right") - 1] = False
        elif repairs.missing == "forward_fill":
            _fill(name, values, wrong, rows, begins)
            filled[name] = len(found)
        if first is None or found[0] < first[0]:
            first = (int(found[0]), name, float(values[found[0]]))
    if first is None:
        return
    row, name, value = first
    if repairs.missing == "refuse":
        what = "is missing" if np.isnan(value) else f"is {value:g}"
        more = f" ({count} missing or infinite values in all)" if count > 1 else ""
        raise LogError(
            f"{rows.place(row)}: {name!r} {what}{more}; repair the log, or give "
            "missing=drop_episode or missing=forward_fill."
        )
    if filled:
        listing = ", ".join(f"{number} of {name}" for name, number in filled.items())
        notes.append(f"Missing values repeat the row before: {listing}.")
    dropped = int((~keep).sum())
    if dropped:
        notes.append(f"{dropped} of {len(keep)} episodes are left out, as values of them miss.")
    if not keep.any():
        raise LogError(
            f"{rows.place(row)}: {name!r} is missing, as are values of every other episode, so "
            "missing=drop_episode leaves nothing; give missing=forward_fill, or shorter episodes."
        )


def _columns(
    rows: Rows, begins: NDArray[np.int64], ends: NDArray[np.int64], schema: LogSchema
) -> list[tuple[str, NDArray[np.float32], NDArray[np.int64] | None]]:
    """Name and values of every column, and the rows whose values are not used."""
    last = ends - 1
    columns: list[tuple[str, Any, Any]] = [
        (name, rows.features[:, n], None) for n, name in enumerate(schema.features)
    ]
    columns += [(name, rows.actions[:, n], last) for n, name in enumerate(schema.actions)]
    if schema.reward:
        unused = begins
        if schema.same_row:
            ended = rows.terminal[last] & (schema.unrecorded_end == "repeat")
            unused = last[~ended]
        columns.append((schema.reward, rows.rewards, unused))
    return columns


def _fill(
    name: str,
    values: NDArray[np.float32],
    wrong: NDArray[np.bool_],
    rows: Rows,
    begins: NDArray[np.int64],
) -> None:
    """Repeat the last value of the same episode."""
    usable = np.isfinite(values)
    source = np.maximum.accumulate(np.where(usable, np.arange(len(values)), -1))
    found = np.flatnonzero(wrong)
    first = begins[np.searchsorted(begins, found, side="right") - 1]
    nothing = source[found] < first
    if nothing.any():
        row = int(found[nothing.argmax()])
        raise LogError(
            f"{rows.place(row)}: {name!r} is missing, and its episode has no value before it to "
            "repeat; repair it, or give missing=drop_episode."
        )
    values[found] = values[source[found]]


def _with_ends(
    rows: Rows,
    begins: NDArray[np.int64],
    ends: NDArray[np.int64],
    schema: LogSchema,
    notes: list[str],
) -> Episodes:
    """Decide about last steps whose next state was not recorded."""
    unrecorded = rows.terminal[ends - 1] & schema.same_row
    repeated = unrecorded & (schema.unrecorded_end == "repeat")
    repeated &= np.isfinite(rows.actions[ends - 1]).all(axis=1)
    if schema.same_row:
        acted = np.isfinite(rows.actions[ends - 1]).all(axis=1)
        dropped = int((acted & ~repeated).sum())
        if dropped:
            lost = int((unrecorded & ~repeated).sum())
            terminal = f", {lost} of them terminal (unrecorded_end can keep these)" if lost else ""
            notes.append(
                f"{dropped} episodes end without the state after their last action; that step is "
                f"dropped{terminal}."
            )
    if repeated.any():
        notes.append(
            f"{int(repeated.sum())} terminal states were not recorded; the state before stands in "
            "their place."
        )
    return Episodes(begins, ends, repeated, notes)


def _long_enough(rows: Rows, found: Episodes, repairs: Repairs) -> Episodes:
    steps = found.ends - found.begins - 1 + found.repeated
    short = steps < 1
    if short.any() and repairs.short == "refuse":
        row = int(found.begins[short.argmax()])
        count = int(short.sum())
        more = f" ({count} such episodes)" if count > 1 else ""
        raise LogError(
            f"{rows.place(row)}: the episode that begins here has a single row, so no whole step"
            f"{more}; give short=drop, or check the columns of episodes and time."
        )
    if short.any():
        found.notes.append(f"{int(short.sum())} episodes without a whole step are left out.")
        long = ~short
        found = Episodes(found.begins[long], found.ends[long], found.repeated[long], found.notes)
    if len(found.begins) < 2:
        number = "one episode" if len(found.begins) else "no episode"
        raise LogError(
            f"the log has {number}; at least 2 are needed, as models are checked on held-out ones; "
            "give episode_rows to cut a long one."
        )
    return found
