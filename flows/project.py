"""How long a plan would take, here and elsewhere: ``python -m flows.project profile=paper``."""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field
from rich.console import Console
from rich.table import Table

from flows.command_line import check_store, run_door
from flows.configuration.checking import StrictModel, build_config
from flows.configuration.files import CONF
from flows.configuration.settings import ALIASES, Settings, load_settings
from flows.configuration.shown import settings_yaml
from flows.configuration.words import fields_of_words
from flows.pipeline.computer import processor
from flows.pipeline.costs import Measurement
from flows.pipeline.executors.processors import available_cpus, check_threads
from flows.pipeline.plan import Plan
from flows.pipeline.progress import duration
from flows.pipeline.schedule import Group, form_groups
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.planning.projection import Machine, Projection, Share, cost_model, project
from flows.planning.rates import Rates, read_rates

__all__ = ["Projected", "ProjectionSettings", "load_projection_settings", "main", "projected"]

HELP = """\
usage: python -m flows.project [KEY=VALUE ...]

Project the hours of a plan on this computer, on one GPU and on a cluster of computers like this
one, with what each estimate is made of: nodes of the store that finished on such a processor, and
the results of `make bench`. Nothing runs, nothing is written. All nodes of the plan count, finished
or not. The settings of flows.full_benchmark choose the plan (profile, datasets, algorithms, seeds,
algorithm.NAME.KEY, ...), show_settings=true prints them.

  rates=FILE.json      results measured here; the newest of benchmarks/results by default; or none
  gpu_rates=FILE.json  results measured on a GPU; benchmarks/results/h200-2026-11.json by default;
                       or none
  computers=10         in the cluster
  host_cores=16        of the computer with the GPU
  format=text          or json
  store=mlruns         whose finished nodes count
  runner.cpus=2        processors to use; all by default
  show_settings=true   print every setting of the plan as YAML and stop
"""

_RESULTS = CONF.parent / "benchmarks" / "results"
_GPU_RATES = _RESULTS / "h200-2026-11.json"
_NONE = "none"
_LITTLE = 0.1  # core-hours of a component below which its kinds are not told apart

_Shares = Mapping[tuple[str, str], Share]


class ProjectionSettings(StrictModel):
    """What to project from, and how to show it."""

    rates: str | None = None
    gpu_rates: str | None = None
    computers: int = Field(default=10, ge=1)
    host_cores: int = Field(default=16, ge=1)
    format: Literal["text", "json"] = "text"


def load_projection_settings(words: Sequence[str]) -> tuple[ProjectionSettings, Settings]:
    """Settings from the command line: this door's own, and those of the plan.

    Raises:
        SettingsError: One sentence.
    """
    own = [w for w in words if w.partition("=")[0] in ProjectionSettings.model_fields]
    others = [word for word in words if word not in own]
    return build_config(ProjectionSettings, "", fields_of_words(own)), load_settings(
        others, ALIASES
    )


@dataclass(frozen=True)
class Projected:
    """A plan on all machines.

    Attributes:
        nodes: In the plan.
        projections: One per machine.
        notes: Sources and assumptions, a sentence each.
    """

    nodes: int
    projections: Sequence[Projection]
    notes: Sequence[str]


def projected(own: ProjectionSettings, settings: Settings) -> Projected:
    """Project a plan.

    Raises:
        SettingsError: A file holds no rates, or the plan cannot be made.
    """
    store = ArtifactStore(settings.store, create=False)
    plan = benchmark_plan(settings)
    here, gpu = _rates(own.rates, _newest()), _rates(own.gpu_rates, _GPU_RATES)
    records = sorted(store.records(), key=lambda record: record.get("finished", 0.0))
    finished = [m for record in records if (m := Measurement.of_record(record)) is not None]
    cores, sources = cost_model(finished, here.measurements if here else (), "cpu", processor())
    cpus = settings.runner.cpus or available_cpus()
    check_threads(settings.runner.threads, cpus)
    slots = cpus // settings.runner.threads
    groups = _groups(plan, store)
    many = Machine(f"{own.computers} computers like it", own.computers * slots)
    machines = [Machine("this computer", slots), many]
    found = [project(groups, machine, cores, sources) for machine in machines]
    notes = _notes(finished, here, slots)
    if gpu is not None:
        name = str(gpu.computer.get("GPU", "the GPU"))
        card, _ = cost_model(finished, gpu.measurements, "cuda", name)
        stacked = settings.runner.model_copy(update={"stack": "algorithm"})
        together = benchmark_plan(settings.model_copy(update={"runner": stacked}))
        machine = Machine(f"one {name}", own.host_cores, gpu=True)
        found.append(project(_groups(together, store), machine, cores, sources, card))
        notes += _gpu_notes(gpu, found[-1], own.host_cores)
    return Projected(len(plan), found, notes)


def _groups(plan: Plan, store: ArtifactStore) -> list[Group]:
    return form_groups(plan, [node.key for node in plan], store)


def _newest() -> Path | None:
    """The newest results of a whole run on processors, by the date in its name."""
    return max(_RESULTS.glob("*-cpu.json"), default=None)


def _rates(given: str | None, usual: Path | None) -> Rates | None:
    if given == _NONE or (given is None and (usual is None or not usual.is_file())):
        return None
    path = Path(given).expanduser() if given else usual
    return read_rates(path) if path else None


def _notes(finished: Sequence[Measurement], here: Rates | None, slots: int) -> list[str]:
    ours = sum(m.device == "cpu" and m.model == processor() for m in finished)
    notes = [f"This computer: {os.cpu_count()} x {processor()}, {slots} calls at once."]
    notes.append(f"Finished nodes in the store that were measured on this processor: {ours}.")
    if here is None:
        notes.append("No rates of benchmarks: `make bench` measures them.")
    else:
        measured = here.computer.get("model") or here.computer.get("processor", "unknown")
        notes.append(
            f"Benchmarks: {here.name}, {here.computer.get('date', 'undated')}, on {measured}."
        )
        notes += here.notes
        if measured != processor():
            notes.append("They are of another processor: take what rests on them with care.")
    notes.append(
        "Kinds without a rate take the median pace of their component, a guess where it has none; "
        "other networks and data take as much longer as they are larger."
    )
    notes.append(
        "A cluster's computers are assumed to be as fast as this one and to wait for none."
    )
    return notes


def _gpu_notes(gpu: Rates, projection: Projection, cores: int) -> list[str]:
    told = ", ".join(f"{k}: {gpu.computer[k]}" for k in ("date", "code") if k in gpu.computer)
    return [
        f"GPU: {gpu.name} ({told}).",
        "One call at a time computes on the GPU, all datasets of equal shape stacked; the time of "
        "a call is a straight line through the numbers of lanes that were measured; its overhead "
        "and the capture of graphs are not counted.",
        f"Unknown on the GPU, and assumed to run on {cores} cores of its host at the pace of this "
        f"computer: {', '.join(projection.unmeasured) or 'nothing'}, data generation, evaluation "
        "and aggregation.",
    ]


def _in_rows(shares: _Shares, by: _Shares) -> dict[tuple[str, str], Share]:
    """Rows of a table: components that take next to nothing get one, the others one per kind.

    Args:
        shares: To be shown.
        by: Those that decide which components take next to nothing.
    """
    totals: dict[str, float] = {}
    for (component, _), share in by.items():
        totals[component] = totals.get(component, 0.0) + share.core_hours
    rows: dict[tuple[str, str], Share] = {}
    for (component, kind), share in shares.items():
        name = component, kind if totals[component] >= _LITTLE else ""
        old = rows.get(name)
        rows[name] = share if old is None else old + share
    order = list(totals)
    return dict(sorted(rows.items(), key=lambda row: (order.index(row[0][0]), -row[1].core_hours)))


def _text(found: Projected) -> None:
    console = Console(highlight=False, soft_wrap=True, width=120)
    here, many, *cards = found.projections
    card = cards[0] if cards else None
    table = Table(box=None, pad_edge=False)
    for name in ("component", "kind"):
        table.add_column(name)
    for name in ("nodes", "core-hours", "h here", "h cluster", "h GPU", "h its host"):
        table.add_column(name, justify="right")
    table.add_column("made of")
    theirs = _in_rows(card.shares, here.shares) if card else {}
    for (component, kind), share in _in_rows(here.shares, here.shares).items():
        other = theirs.get((component, kind))
        on_card, on_host = "", ""
        if card and other:
            on_card = f"{other.gpu_hours:,.2f}" if other.gpu_hours else ""
            on_host = "" if other.gpu_hours else f"{other.core_hours / card.machine.slots:,.2f}"
        table.add_row(
            component.replace("_", " "),
            kind,
            f"{share.nodes:,}",
            f"{share.core_hours:,.1f}",
            f"{share.core_hours / here.machine.slots:,.1f}",
            f"{share.core_hours / many.machine.slots:,.2f}",
            on_card,
            on_host,
            share.source,
        )
    console.print(table)
    console.print()
    for p in found.projections:
        spent = f"{p.core_hours:,.0f} core-hours"
        spent += f" and {p.gpu_hours:,.2f} hours of the GPU" if p.machine.gpu else ""
        console.print(
            f"{p.machine.name}: {duration(3600 * p.hours)} ({spent}; limit: {p.limit}, longest "
            f"chain {duration(3600 * p.critical_hours)})"
        )
    console.print()
    for note in found.notes:
        console.print(f"- {note}")


def _as_json(found: Projected) -> str:
    machines = []
    for p in found.projections:
        numbers = asdict(p) | {"machine": p.machine.name, "slots": p.machine.slots}
        numbers["shares"] = [
            {"component": component, "kind": kind, **asdict(share)}
            for (component, kind), share in p.shares.items()
        ]
        machines.append(numbers)
    return json.dumps(
        {"nodes": found.nodes, "machines": machines, "notes": list(found.notes)}, indent=1
    )


def _run(words: tuple[ProjectionSettings, Settings]) -> int:
    own, settings = words
    for note in settings.notes:
        print(f"Note: {note}", file=sys.stderr)
    if settings.show_settings:
        print(settings_yaml(settings), end="")
        return 0
    check_store(settings.store)
    found = projected(own, settings)
    if own.format == "json":
        print(_as_json(found))
    else:
        _text(found)
    return 0


def main() -> None:
    """Command line."""
    run_door("project", HELP, load_projection_settings, _run)


if __name__ == "__main__":
    main()
