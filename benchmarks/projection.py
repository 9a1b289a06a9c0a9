"""A projection against the clock: ``python -m benchmarks.projection``, minutes on a quiet computer.

`[--store FOLDER] [--rates FILE.json] [SETTING=VALUE ...]`. Projects a slice of the
benchmark from nodes that finished in a store and from stored rates, runs it in a store of its own,
and compares: the processor time of every component and kind, and the time from the first start to
the last end. The exit code is 1 if the latter is off by more than a fifth. Settings choose another
slice.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import computer, markdown
from flows.pipeline.costs import kind_of
from flows.pipeline.store import ArtifactStore

__all__ = ["SLICE", "compared", "measured_hours"]

SLICE = (
    "datasets=[mediocre-0.2]",
    "algorithms=[bc,td3_bc,cql]",
    "seeds=[0,1,2,3,4]",
    "algorithm.bc.updates=5000",
    "algorithm.td3_bc.updates=2500",
    "algorithm.cql.updates=250",
    "model.behaviour_policy.epochs=50",
)
"""One dataset's BC, TD3+BC and CQL at reduced budgets: about five minutes on two cores."""

_ALLOWED = 0.2  # relative error of the whole
_HOUR = 3600.0
_ROOT = Path(__file__).resolve().parents[1]

Hours = dict[tuple[str, str], float]


def _door(name: str, words: Sequence[str]) -> str:
    command = [sys.executable, "-m", f"flows.{name}", *words]
    return subprocess.run(command, cwd=_ROOT, check=True, text=True, stdout=subprocess.PIPE).stdout


def measured_hours(records: Sequence[Mapping[str, Any]]) -> tuple[Hours, float]:
    """Processor hours by component and kind, and hours from the first start to the last end."""
    found: Hours = {}
    for record in records:
        name = record["component"], kind_of(record["tags"])
        used = min(record["seconds"], record["share"] * record["cpu_seconds"])
        found[name] = found.get(name, 0.0) + used / _HOUR
    first = min(record["started"] for record in records)
    return found, (max(record["finished"] for record in records) - first) / _HOUR


def compared(
    projection: Mapping[str, Any], records: Sequence[Mapping[str, Any]]
) -> tuple[str, float]:
    """A Markdown table, and projected over measured time of the whole.

    Args:
        projection: What flows.project printed as JSON.
        records: Of the nodes of the slice that ran.
    """
    here = projection["machines"][0]
    found, whole = measured_hours(records)
    rows = []
    for share in here["shares"]:
        hours = found.get((share["component"], share["kind"]), 0.0)
        told = [share["component"], share["kind"], share["source"]]
        rows.append([*told, *_numbers(share["core_hours"], hours)])
    rows.append(
        ["all, by the clock", "", f"{here['slots']} at once", *_numbers(here["hours"], whole)]
    )
    columns = ["component", "kind", "made of", "projected s", "measured s", "ratio"]
    return markdown(columns, rows, texts=3), here["hours"] / whole


def _numbers(projected: float, measured: float) -> list[str]:
    ratio = f"{projected / measured:.2f}" if measured else "-"
    return [f"{_HOUR * projected:,.1f}", f"{_HOUR * measured:,.1f}", ratio]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.projection", description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("mlruns"), help="of finished nodes")
    parser.add_argument("--rates", help="results of benchmarks.run, or none; default: the newest")
    parser.add_argument("settings", nargs="*", metavar="SETTING=VALUE", help="another slice")
    options = parser.parse_args()
    chosen = options.settings or list(SLICE)
    words = [*chosen, f"store={options.store.absolute()}", "gpu_rates=none", "format=json"]
    projection = json.loads(
        _door("project", words + ([f"rates={options.rates}"] if options.rates else []))
    )
    for note in projection["notes"]:
        print(f"- {note}")
    print(f"Projected: {60 * projection['machines'][0]['hours']:.1f} minutes.", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        _door("full_benchmark", [*chosen, f"store={folder}", "runner.tracker=none"])
        records = list(ArtifactStore(folder, create=False).records())
    table, ratio = compared(projection, records)
    print(f"\n{table}\n\n{computer()}")
    sys.exit(int(abs(ratio - 1.0) > _ALLOWED))


if __name__ == "__main__":
    main()
