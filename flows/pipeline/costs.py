"""Seconds that task calls take: planned costs, scaled by what finished nodes have recorded.

A call takes an overhead (imports, opening its inputs, writing what it made) and time in proportion
to its work. A worker sees the two apart, by the pace of the fractions that a task reports: what is
learned from small budgets then holds for large ones. Only times of the same kind of device count,
and of these, those of the same model where there are any. Lanes share a call: how its time grows
with their number is interpolated where it was measured for several.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from flows.pipeline.plan import Node

__all__ = ["BOOKKEEPING", "RULES", "CostModel", "Measurement", "kind_of"]

RULES: Final = 2
"""Of the costs of plans; raise it when they change, since a record's time relates to its cost."""

_LEAST: Final = 1.0
"""Cost of a call that tells a pace: the time of less work is that of its beginning and end, which
says what to expect of other calls whose pace is unknown."""

BOOKKEEPING: Final = 0.035
"""Core-seconds in which the driver hands out, records and logs a node, rounded up from those in
docs/speed.md."""

_NEWEST: Final = 50  # measurements that count: they come from code and load most like the present


def kind_of(tags: Mapping[str, str]) -> str:
    """What nodes of a component differ by in their pace: the algorithm, the model or the robot."""
    return next((tags[name] for name in ("algorithm", "model", "robot") if name in tags), "")


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What one call took.

    Attributes:
        component: Of its nodes.
        kind: See :func:`kind_of`.
        device: "cpu" or "cuda".
        model: Of the processor or GPU; empty if unknown.
        lanes: Nodes in the call.
        cost: Planned, of all of them.
        seconds: In proportion to the cost; 0 if there was next to nothing to do.
        overhead: Further ones.
    """

    component: str
    kind: str
    device: str = "cpu"
    model: str = ""
    lanes: int = 1
    cost: float
    seconds: float
    overhead: float = 0.0

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> "Measurement | None":
        """What the `node.json` of a finished node tells about its call, if it can be used.

        None of a call that was continued after a kill, that was planned by other rules, or that
        took less than no time, as older stores have it of computers whose clock was set back. Time
        in which a call waited for a processor that other programs used does not count.
        """
        if record.get("cost_rules") != RULES or record.get("resumed") or not record.get("cost"):
            return None
        share = float(record["share"])
        whole = float(record["seconds"]) / share
        device = record.get("device", "cpu")
        busy = 1.0
        if device == "cpu" and whole > 0.0:
            busy = min(1.0, record.get("cpu_seconds", whole) / whole)
        steady = record.get("steady_seconds")
        seconds = whole if steady is None else min(float(steady), whole)
        if whole < 0.0 or seconds <= 0.0:
            return None
        if float(record["cost"]) / share < _LEAST:
            seconds = 0.0
        return cls(
            component=record["component"],
            kind=kind_of(record.get("tags", {})),
            device=device,
            model=record.get("software", {}).get("device", ""),
            lanes=record.get("lanes", 1),
            cost=float(record["cost"]) / share,
            seconds=busy * seconds,
            overhead=busy * (whole - seconds),
        )


class CostModel:
    """Expected seconds of calls on one kind of device."""

    def __init__(
        self, records: Iterable[Mapping[str, Any]] = (), device: str = "cpu", model: str = ""
    ) -> None:
        """Starts from what finished nodes recorded in their `node.json`.

        Args:
            records: Oldest first.
            device: Where calls will run, "cpu" or "cuda".
            model: Of the processor or GPU; empty: any.
        """
        self.device, self._model = device, model
        self._found: dict[tuple[str, str], list[Measurement]] = {}
        self._small: dict[str, list[float]] = {}  # overheads of calls that tell no pace
        self._rates: dict[tuple[str, str, int], tuple[float, float]] = {}
        for record in records:
            self.learn(record)

    @property
    def measured(self) -> bool:
        """Whether anything has been measured on such a device."""
        return bool(self._found)

    @property
    def source(self) -> str:
        """What estimates are made of, for people."""
        if self.measured:
            return "from measured times"
        if self.device == "cpu":
            return "a rough guess"
        return "a rough guess for processor cores: nothing in this store was measured on a GPU"

    def learn(self, record: Mapping[str, Any]) -> None:
        """Learns from one finished node, if its record can be used."""
        measurement = Measurement.of_record(record)
        if measurement is not None:
            self.add(measurement)

    def add(self, measurement: Measurement) -> None:
        """Learns from one call, if it ran on such a device."""
        if measurement.device != self.device:
            return
        if measurement.seconds:
            name = measurement.component, measurement.kind
            self._found.setdefault(name, []).append(measurement)
        else:
            self._small.setdefault(measurement.component, []).append(measurement.overhead)
        self._rates.clear()

    def knows(self, component: str, kind: str) -> bool:
        """Whether such a node has been measured itself, not only others of its component."""
        return (component, kind) in self._found

    def has(self, component: str) -> bool:
        """Whether any node of a component has been measured."""
        return any(of == component for of, _ in self._found)

    def seconds(self, nodes: Sequence[Node]) -> float:
        """Expected seconds of nodes computed in one call."""
        if not nodes:
            return 0.0
        component, kind, lanes = nodes[0].component, kind_of(nodes[0].tags), len(nodes)
        name = component, kind, lanes
        if name not in self._rates:  # asked for every group of a plan at every look at it
            self._rates[name] = self._rate(*name)
        overhead, rate = self._rates[name]
        return overhead + rate * sum(node.cost for node in nodes)

    def _rate(self, component: str, kind: str, lanes: int) -> tuple[float, float]:
        """Seconds of a call, and further ones per unit of cost."""
        kinds = [kind]
        if not self.knows(component, kind):
            kinds = [other for of, other in self._found if of == component]
        if not kinds:
            small = self._small.get(component, [])[-_NEWEST:]
            return median(small) if small else 0.0, 1.0
        measured = [self._newest(component, other) for other in kinds]
        # of several kinds each counts once, however often it was measured
        overhead = median(median(m.overhead for m in several) for several in measured)
        return overhead, median(_seconds_per_cost(several, lanes) for several in measured)

    def _newest(self, component: str, kind: str) -> list[Measurement]:
        found = self._found[component, kind]
        return ([m for m in found if m.model == self._model] or found)[-_NEWEST:]


def _seconds_per_cost(measured: Sequence[Measurement], lanes: int) -> float:
    """Seconds per unit of cost in a call of so many lanes.

    A call of L lanes takes L times as long per unit of one lane's cost. That time is taken as a
    straight line between, and beyond, the numbers of lanes that were measured, and it never falls.
    """
    rates: dict[int, list[float]] = {}
    for m in measured:
        rates.setdefault(m.lanes, []).append(m.seconds / m.cost)
    line = sorted((count, count * median(several)) for count, several in rates.items())
    if len(line) == 1:
        return line[0][1] / line[0][0]
    first = max(0, min(sum(count <= lanes for count, _ in line), len(line) - 1) - 1)
    (x0, y0), (x1, y1) = line[first], line[first + 1]
    whole = y0 + (y1 - y0) * (lanes - x0) / (x1 - x0)
    if lanes < x0:
        whole = min(max(whole, y0 * lanes / x0), y0)
    elif lanes > x1:
        whole = max(whole, y1)
    return whole / lanes
