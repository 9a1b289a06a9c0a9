"""Rates that `python -m benchmarks.run` has measured, as measurements that estimates learn from.

A row of its results that says how long a known piece of work took holds a `rate`: component, kind,
device, lanes, threads, processes side by side, seconds, and what decides the cost: settings that
differ from the defaults, transitions, or states. All were measured on the Industrial Benchmark.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from components.algorithms import ALGORITHMS
from components.data.sizes import DataSizes
from components.models import MODELS
from flows.configuration.checking import SettingsError
from flows.pipeline.costs import Measurement
from flows.planning.costs import evaluation_cost

__all__ = ["Rates", "read_rates"]


@dataclass(frozen=True)
class Rates:
    """The rates in a file of results.

    Attributes:
        name: Of the file.
        computer: What the file says about hardware, versions and date.
        measurements: One per row with a rate.
        notes: How they were made comparable, a sentence each.
    """

    name: str
    computer: Mapping[str, Any]
    measurements: tuple[Measurement, ...]
    notes: tuple[str, ...] = ()


def read_rates(path: Path) -> Rates:
    """Read a file of results.

    On processors, rates of one process with all threads become those of one core of a computer
    whose other cores do the same: by the learners that were also measured side by side, each by its
    own ratio and the others by the median one.

    Raises:
        SettingsError: It is missing or holds something else.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        computer = dict(stored["computer"])
        rates = [row["rate"] for row in stored["rows"] if row.get("rate")]
        rates = [rate for rate in rates if rate["kind"] in (*ALGORITHMS, *MODELS)]
        measurements = {id(rate): _measurement(rate, computer) for rate in rates}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}" if isinstance(error, KeyError) else str(error)
        raise SettingsError(
            f"{path} holds no results of benchmarks.run ({reason}); name a file that it wrote."
        ) from error
    factors, notes = _core_factors(rates)
    found = []
    for rate in rates:
        if rate["processes"] == 1:
            m = measurements[id(rate)]
            factor = factors.get(m.kind, factors[""]) if m.device == "cpu" else 1.0
            found.append(Measurement(**{**vars(m), "seconds": factor * m.seconds}))
    return Rates(path.name, computer, tuple(found), tuple(notes))


def _core_factors(rates: Sequence[Mapping[str, Any]]) -> tuple[dict[str, float], list[str]]:
    """Times a core takes longer than the whole process, by kind, and for other kinds under ""."""
    alone = {(r["kind"], r["lanes"]): r["seconds"] for r in rates if r["processes"] == 1}
    beside = {(r["kind"], r["lanes"]): r["seconds"] for r in rates if r["processes"] > 1}
    factors = {name[0]: beside[name] / alone[name] for name in beside.keys() & alone.keys()}
    threads = max((r["threads"] for r in rates if r["device"] == "cpu"), default=1)
    if factors:
        factors[""] = median(factors.values())
        note = (
            f"One of the cores, all at work, takes {factors['']:.2f} times as long as one process "
            f"with {threads} thread(s): measured for {', '.join(sorted(factors.keys() - {''}))}."
        )
        return factors, [note]
    note = f"{threads} threads are assumed to work {threads} times as fast as one."
    return {"": float(threads)}, [note] if threads > 1 else []


def _measurement(rate: Mapping[str, Any], computer: Mapping[str, Any]) -> Measurement:
    device = rate["device"]
    return Measurement(
        component=rate["component"],
        kind=rate["kind"],
        device=device,
        model=str(computer.get("GPU" if device == "cuda" else "model", "")),
        lanes=rate["lanes"],
        cost=rate["lanes"] * _cost(rate),
        seconds=float(rate["seconds"]),
    )


def _cost(rate: Mapping[str, Any]) -> float:
    """What a plan would say that the measured work costs, per lane."""
    kind, changed = rate["kind"], rate.get("settings", {})
    if rate["component"] == "evaluation":
        config = ALGORITHMS[kind].config()
        return evaluation_cost(config, DataSizes(), rate["states"], robot=False)
    record = MODELS[kind] if rate["component"] == "model_fitting" else ALGORITHMS[kind]
    sizes = DataSizes(transitions=rate.get("transitions", DataSizes.transitions))
    return record.cost(record.config(**changed), sizes)
