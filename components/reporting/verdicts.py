"""A verdict per dataset in plain words: does learning from this log pay, and how surely?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from components.reporting.evidence import Cell, Evidence
from components.reporting.overview import Column, Value, shown

__all__ = ["Verdict", "verdicts"]

_HARDLY: Final = 0.01  # share of the logged return below which a gain is hardly one

Judgement = Literal["gain", "unsure", "none", "unknown"]


@dataclass(frozen=True)
class Verdict:
    """What to make of a dataset.

    Attributes:
        dataset: Its name.
        judgement: In one word.
        headline: In a few words.
        sentences: Why, and what to watch out for.
    """

    dataset: str
    judgement: Judgement
    headline: str
    sentences: Sequence[str]


def verdicts(evidence: Evidence) -> list[Verdict]:
    """One verdict per dataset, in the order of the table."""
    return [_verdict(evidence, dataset) for dataset in evidence.table.logged]


def _verdict(evidence: Evidence, dataset: str) -> Verdict:
    level = evidence.table.logged[dataset]
    row = evidence.table.comparable(dataset)
    found = [(column, value) for column, value in row.items() if math.isfinite(value.value)]
    if not evidence.on(dataset):
        return Verdict(dataset, "unknown", "Not finished yet", [])
    if not found:
        return Verdict(dataset, "unknown", "No result", ["No policy has a finite return."])
    column, best = max(found, key=lambda pair: pair[1].value)
    name = _named(column, best)
    if level is None or best.difference is None:
        return Verdict(
            dataset,
            "unknown",
            f"Best: {name}",
            [
                f"It reaches {shown(best.value)}. Whether that is better than the log cannot be "
                "said: these episodes are counted otherwise than the log's."
            ],
        )
    judgement, headline = _judge(best, level)
    level = best.value - best.difference  # of the log of its own sweep
    gain = best.difference
    sentences = [
        f"The best is {name}: {_of_whom(best)} {shown(best.value)} or more, "
        f"{'above' if gain > 0 else 'against'} the {shown(level)} of what was logged"
        + (f", a gain of {gain:.1f} ({gain / abs(level):.0%})." if gain > 0 else ".")
    ]
    sentences += _how_many(found, level)
    for cell in evidence.on(dataset):
        if cell.adapts and cell.algorithm in {column.algorithm for column in row}:
            sentences.append(_how_far(cell, level))
    return Verdict(dataset, judgement, headline, sentences)


def _of_whom(best: Value) -> str:
    one_seed = math.isnan(best.interval[0])
    return "those of its one seed reach" if one_seed else "nine in ten of its policies reach"


def _named(column: Column, cell: Value) -> str:
    if not column.point:
        return column.algorithm
    place = column.point if cell.proximity is None else f"{cell.proximity:.2f}"
    return f"{column.algorithm} at λ {place}"


def _judge(best: Value, level: float) -> tuple[Judgement, str]:
    gain, (low, high) = best.value - level, best.interval
    if gain <= 0:
        return "none", "As good as the log at most" if high >= level else "Leave it as it is"
    if math.isnan(low):
        return "unsure", "A gain seen once"
    if low <= level:
        return "unsure", "A gain that may be luck"
    if gain < _HARDLY * abs(level):
        return "unsure", "Hardly any gain"
    return "gain", "Learning from this log pays"


def _how_many(found: Sequence[tuple[Column, Value]], level: float) -> list[str]:
    """How many algorithms are above the log, and which is furthest below."""
    algorithms = {column.algorithm for column, _ in found}
    above = {column.algorithm for column, cell in found if cell.value > level}
    column, worst = min(found, key=lambda pair: pair[1].value)
    said = [f"{len(above)} of {len(algorithms)} algorithms are above the log."]
    if worst.value < level:
        said.append(
            f"Beware of {_named(column, worst)}: {shown(worst.value)}, "
            f"{level - worst.value:.1f} below the log."
        )
    return said


def _how_far(cell: Cell, level: float) -> str:
    """How far λ can be raised before results fall below the log."""
    ordered = [(float(p["lambda"]), float(p["tenth_percentile"])) for p in cell.points]
    above = [place for place, value in ordered if value >= level]
    if not above:
        return f"{cell.algorithm} stays below the log for every λ."
    first = last = above[0]
    for place, value in ordered:
        if place > first and value < level:
            break
        last = max(last, place)
    name = cell.algorithm
    if last == first:
        return f"{name} is above the log at λ {first:.2f} only."
    if first > 0.0:
        return f"{name} is above the log for λ from {first:.2f} to {last:.2f}."
    if last >= 1.0:
        return f"{name} is above the log for every λ: the operator may go up to 1."
    return f"{name} stays above the log up to λ {last:.2f}: the operator should stop there."
