"""Rates of learners on a GPU against their targets, and the kernels they consist of."""

import dataclasses
from collections.abc import Iterator, Mapping
from types import MappingProxyType

from torch.profiler import ProfilerActivity, profile

from benchmarks.gpu_paths import models_of, small_settings, stack, with_graphs
from benchmarks.learner_paths import MEASURE, Training
from benchmarks.records import Row, row_of_seconds
from benchmarks.settings import Settings
from components.training.cuda_graphs import lost_graphs

__all__ = ["TARGETS", "rates"]

TARGETS: Mapping[tuple[str, int], float] = MappingProxyType(
    {
        ("td3_bc", 5): 6530.0,  # 1.2 times what plain JAX did on an H200
        ("td3_bc", 80): 1128.0,
        ("ddpg", 80): 1500.0,
        ("bcq", 80): 250.0,
        ("bear", 80): 150.0,
        ("brac", 80): 500.0,
        ("cql", 80): 100.0,
        ("lion", 80): 40.0,
        ("wsbc", 80): 100.0 / 60.0,  # 100 iterations in a minute
    }
)
"""Updates per second that are asked for, by learner and number of lanes."""

_TOP = 12  # kernels shown of each learner


def rates(name: str, settings: Settings) -> Iterator[Row]:
    """Rows of a learner for each number of lanes, and of the kernels of the last one."""
    dataset = settings.dataset()
    models = models_of([name], dataclasses.replace(settings, quick=True).dataset())
    changes = small_settings(name, True) if settings.quick else {}
    for lanes in settings.lanes:
        made = stack(name, dataset, models, lanes, settings.place, **changes)
        first = made.pretraining + made._config.updates // 2
        training = Training(with_graphs(made, settings), made.updates_per_graph, first)
        with lost_graphs() as lost:
            timings = training.timings(settings)
        yield row_of_seconds(
            f"learner {name}",
            f"{name}, {lanes} lane(s)",
            timings,
            amount=float(lanes),
            measure=MEASURE,
            note="; ".join([_judged(name, lanes, 1.0 / min(timings)), *lost]),
        )
    yield from _kernels(name, training, settings)


def _judged(name: str, lanes: int, rate: float) -> str:
    asked = TARGETS.get((name, lanes))
    said = f"{rate:,.1f} updates/s"
    if asked is None:
        return said
    return f"{said}; target {asked:,.1f} {'met' if rate >= asked else 'missed'}"


def _kernels(name: str, training: Training, settings: Settings) -> Iterator[Row]:
    """Rows of what the device, or a processor, spends its time on."""
    updates = 2 * training.several
    activities = [ProfilerActivity.CUDA] if settings.on_a_gpu else []
    with profile(activities=[ProfilerActivity.CPU, *activities]) as found:
        training.advance(updates)
        settings.settle()
    clock = "self_device_time_total" if settings.on_a_gpu else "self_cpu_time_total"
    spent = {event: float(getattr(event, clock)) for event in found.key_averages()}
    ordered = sorted(
        (event for event in spent if spent[event] > 0), key=spent.__getitem__, reverse=True
    )
    total = sum(spent.values())
    unit = f"kernels of {name}, {settings.lanes[-1]} lane(s)"
    yield Row(
        unit=unit,
        name="all",
        value=total / updates,
        measure="us/update",
        note=f"{sum(event.count for event in ordered) / updates:,.1f} per update",
    )
    for event in ordered[:_TOP]:
        yield Row(
            unit=unit,
            name=event.key[:90].replace("|", "/"),
            value=100.0 * spent[event] / total,
            measure="%",
            note=f"{event.count / updates:,.1f} per update",
        )
