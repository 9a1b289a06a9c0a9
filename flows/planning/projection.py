"""How long a plan takes on a computer that need not be this one, from measured rates.

Calls of processor cores are scheduled as the runner does it. A GPU computes one call after the
other, since its rates were measured so; what was not measured on it is assumed to run on the cores
of its host. Shares of core-hours say where the time goes, not when it passes.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from flows.pipeline.costs import CostModel, Measurement, kind_of
from flows.pipeline.schedule import Group, simulate_schedule

__all__ = ["Machine", "Projection", "Share", "cost_model", "project"]

_HOUR = 3600.0


@dataclass(frozen=True)
class Machine:
    """A computer, or several alike.

    Attributes:
        name: For people.
        slots: Calls that its cores compute at once.
        gpu: Whether it has one GPU beside them.
    """

    name: str
    slots: int
    gpu: bool = False


@dataclass(frozen=True)
class Share:
    """What the calls of one kind take on a machine.

    Attributes:
        nodes: In them.
        calls: Their number.
        core_hours: Of processors.
        gpu_hours: Of the GPU.
        source: What the estimate is made of.
    """

    nodes: int
    calls: int
    core_hours: float
    gpu_hours: float
    source: str

    def __add__(self, other: "Share") -> "Share":
        return Share(
            self.nodes + other.nodes,
            self.calls + other.calls,
            self.core_hours + other.core_hours,
            self.gpu_hours + other.gpu_hours,
            self.source if self.source == other.source else "several",
        )


@dataclass(frozen=True)
class Projection:
    """A plan on a machine.

    Attributes:
        machine: The machine.
        hours: Until all is done.
        core_hours: Of processors.
        gpu_hours: Of the GPU.
        critical_hours: Of the longest chain of calls, which no further core shortens.
        limit: What decides the hours: "cores", "the GPU" or "critical path".
        shares: By component and kind.
        unmeasured: Kinds that were not measured on the GPU.
    """

    machine: Machine
    hours: float
    core_hours: float
    gpu_hours: float
    critical_hours: float
    limit: str
    shares: Mapping[tuple[str, str], Share]
    unmeasured: Sequence[str] = field(default_factory=tuple)


def cost_model(
    nodes: Iterable[Measurement], rates: Iterable[Measurement], device: str, model: str = ""
) -> tuple[CostModel, dict[tuple[str, str], str]]:
    """Expected seconds, and what those of each kind are made of.

    Finished nodes come first, since they ran as others will. Rates of benchmarks stand in for
    kinds without any; they know no overhead, so that of their component is taken.

    Args:
        nodes: Of finished nodes.
        rates: Of benchmarks.
        device: "cpu" or "cuda".
        model: Of the processor or GPU; measurements of others do not count. Empty: any.
    """
    learned = CostModel(device=device, model=model)
    sources: dict[tuple[str, str], str] = {}
    overheads: dict[str, list[float]] = {}
    numbers: dict[tuple[str, str], int] = {}

    def counts(m: Measurement) -> bool:
        return m.device == device and (not model or m.model == model)

    for m in filter(counts, nodes):
        learned.add(m)
        overheads.setdefault(m.component, []).append(m.overhead)
        if m.seconds:
            numbers[m.component, m.kind] = numbers.get((m.component, m.kind), 0) + 1
    sources |= {name: f"{number} finished" for name, number in numbers.items()}
    known = set(sources)
    for m in rates:
        name = m.component, m.kind
        if m.device != device or name in known:
            continue
        overhead = median(overheads.get(m.component, [0.0]))
        learned.add(Measurement(**{**vars(m), "model": model, "overhead": overhead}))
        sources[name] = "benchmark"
    return learned, sources


def project(
    groups: Sequence[Group],
    machine: Machine,
    cores: CostModel,
    sources: Mapping[tuple[str, str], str],
    card: CostModel | None = None,
) -> Projection:
    """How long calls take on a machine.

    Args:
        groups: The calls, in an order in which they can run.
        machine: Where.
        cores: Expected seconds on one of its cores.
        sources: What these are made of, by component and kind.
        card: Expected seconds on its GPU.
    """
    seconds: dict[str, float] = {}
    on_card: dict[str, bool] = {}
    for group in groups:
        name = group.component, kind_of(group.nodes[0].tags)
        on_card[group.name] = machine.gpu and card is not None and card.knows(*name)
        model = card if on_card[group.name] and card is not None else cores
        seconds[group.name] = model.seconds(group.nodes)
    core_hours = sum(s for name, s in seconds.items() if not on_card[name]) / _HOUR
    gpu_hours = sum(s for name, s in seconds.items() if on_card[name]) / _HOUR
    critical = _last(groups, seconds, len(groups)) / _HOUR
    scheduled = (
        max(core_hours / machine.slots, gpu_hours, critical)
        if machine.gpu
        else _last(groups, seconds, machine.slots) / _HOUR
    )
    limits = {
        "cores": core_hours / machine.slots,
        "the GPU": gpu_hours,
        "critical path": critical,
    }
    shares = _shares(groups, seconds, on_card, cores, sources)
    missing = {
        kind
        for (component, kind), share in shares.items()
        if machine.gpu and not share.gpu_hours and component in ("policy_training", "model_fitting")
    }
    limit = max(limits, key=lambda name: limits[name])
    return Projection(
        machine, scheduled, core_hours, gpu_hours, critical, limit, shares, sorted(missing)
    )


def _last(groups: Sequence[Group], seconds: Mapping[str, float], slots: int) -> float:
    return max(simulate_schedule(groups, seconds, slots).values(), default=0.0)


def _shares(
    groups: Sequence[Group],
    seconds: Mapping[str, float],
    on_card: Mapping[str, bool],
    cores: CostModel,
    sources: Mapping[tuple[str, str], str],
) -> dict[tuple[str, str], Share]:
    shares: dict[tuple[str, str], Share] = {}
    for group in groups:
        name = group.component, kind_of(group.nodes[0].tags)
        hours, gpu = seconds[group.name] / _HOUR, on_card[group.name]
        others = "others of its component" if cores.has(group.component) else "guess"
        share = Share(
            nodes=len(group.nodes),
            calls=1,
            core_hours=0.0 if gpu else hours,
            gpu_hours=hours if gpu else 0.0,
            source="benchmark on the GPU" if gpu else sources.get(name, others),
        )
        shares[name] = shares[name] + share if name in shares else share
    return shares
