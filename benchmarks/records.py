"""Rows of a speed measurement, and the pair of files in which a run of them is stored.

A row is one number with what is needed to judge it: repeats and their spread, the same of a peer
as a row of its own under the same name, and the floor that arithmetic sets, where one can be stated
honestly. What failed or was left out is a row as well, and says why.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.measure import markdown
from components.core.files import write_json

__all__ = ["Results", "Row", "row_of_seconds"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number, or why there is none.

    Attributes:
        unit: Of the benchmark that measured it.
        name: What was measured; ours and its peers have the same.
        peer: Whose program, with its version; empty: ours.
        value: Median over the repeats. None: see `note`.
        measure: Its unit; of one that ends in "/s" more is better, of others less.
        repeats: Number of timings.
        spread: Of the repeats, (greatest - least) / median.
        floor: The value that the computer cannot beat.
        bound: What sets the floor.
        above: How many times slower than the floor.
        note: Anything further, such as an error.
        rate: What projections read of it, see :mod:`flows.planning.rates`; None: nothing.
    """

    unit: str
    name: str
    peer: str = ""
    value: float | None = None
    measure: str = ""
    repeats: int = 0
    spread: float = 0.0
    floor: float | None = None
    bound: str = ""
    above: float | None = None
    note: str = ""
    rate: Mapping[str, Any] | None = None

    @property
    def seconds(self) -> float:
        """Something proportional to the time taken; NaN without a value."""
        if not self.value:
            return float("nan")
        return 1.0 / self.value if self.measure.endswith("/s") else self.value


def row_of_seconds(
    unit: str,
    name: str,
    timings: Sequence[float],
    *,
    amount: float | None = None,
    measure: str = "s",
    floor: float | None = None,
    bound: str = "",
    peer: str = "",
    note: str = "",
    rate: Mapping[str, Any] | None = None,
) -> Row:
    """A row made of timings.

    Args:
        unit: Of the benchmark.
        name: What was timed.
        timings: Seconds of each repeat.
        amount: Of work per timing, for a rate; None: the value is the time itself.
        measure: Unit of the value.
        floor: Seconds below which it cannot be done.
        bound: What sets the floor.
        peer: Whose program, empty for ours.
        note: Anything further.
        rate: For projections; the seconds are added to it.
    """
    middle = median(timings)
    scale = 1e3 if measure.startswith("ms") else 1.0

    def shown(seconds: float) -> float:
        return amount / seconds if amount is not None else scale * seconds

    return Row(
        unit=unit,
        name=name,
        peer=peer,
        value=shown(middle),
        measure=measure,
        repeats=len(timings),
        spread=(max(timings) - min(timings)) / middle,
        floor=shown(floor) if floor else None,
        bound=bound if floor else "",
        above=middle / floor if floor else None,
        note=note,
        rate=None if rate is None else {**rate, "seconds": middle},
    )


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


@dataclass
class Results:
    """Everything that a run has found so far.

    Attributes:
        computer: Hardware, versions, date, threads, settings, by name.
        rows: In the order of their benchmarks.
        finished: Names of the benchmarks that have ended, whether well or not.
    """

    computer: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    finished: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> "Results":
        """The results in a JSON file that :meth:`write` made.

        Raises:
            ValueError: It holds something else.
        """
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            rows = [Row(**row) for row in stored["rows"]]
            return cls(stored["computer"], rows, stored["finished"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} holds no results of benchmarks.run: {error}.") from None

    def write(self, path: Path) -> None:
        """Store as JSON, and as Markdown beside it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        stored: Mapping[str, Any] = {
            "computer": self.computer,
            "finished": self.finished,
            "rows": [asdict(row) for row in self.rows],
        }
        write_json(path, stored)
        path.with_suffix(".md").write_text(self.markdown(), encoding="utf-8")

    def markdown(self) -> str:
        """The computer, then a table per benchmark."""
        lines = ["# Measured speed", ""]
        lines += [f"- {name}: {value}" for name, value in self.computer.items()]
        lines += [
            "",
            "Medians; the spread is (greatest - least) / median of the repeats. The floor is what "
            "the measured matrix rate or bandwidth allows, or what its column says. `ours is` says "
            "how many times as fast as the peer of this row ours is.",
        ]
        for unit in dict.fromkeys(row.unit for row in self.rows):
            lines += ["", f"## {unit}", "", self._table([r for r in self.rows if r.unit == unit])]
        return "\n".join(lines) + "\n"

    def _table(self, rows: Sequence[Row]) -> str:
        ours = {row.name: row.seconds for row in self.rows if not row.peer}
        cells = []
        for row in rows:
            ratio = row.seconds / ours.get(row.name, float("nan")) if row.peer else float("nan")
            cells.append(
                [
                    row.name,
                    row.peer or "ours",
                    row.note,
                    f"{_number(row.value)} {row.measure}" if row.value is not None else "-",
                    str(row.repeats or ""),
                    f"{row.spread:.0%}" if row.repeats > 1 else "",
                    "" if ratio != ratio else f"{ratio:.2f}",
                    f"{_number(row.floor)} ({row.bound})" if row.floor is not None else "",
                    _number(row.above),
                ]
            )
        heads = ["what", "program", "note", "value", "repeats", "spread", "ours is", "floor"]
        return markdown([*heads, "times above"], cells, texts=3)
