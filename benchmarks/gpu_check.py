"""What a GPU must show, in less than eight minutes: ``python -m benchmarks.gpu_check``.

`[--device cuda] [--quick] [--minutes 8] [--only NAME ...]`. Three checks and the rates:

- `draws`: every learner draws on the device what it draws on the processor;
- `twins`: every learner, small, follows its plain twin on the processor over 100 updates;
- `captures`: every learner of the usual size is captured, all in one process, in TF32;
- one per learner with a target: updates per second at 5 and 80 lanes in TF32, and the kernels of
  which they consist; beside plain JAX where `make peers` has installed it.

Each is a process of its own, one after the other; after each the results are stored as a JSON and a
Markdown file under `benchmarks/results/`. What no time was left for says so. The exit code is 1 if
a check failed; a missed target is told and is no failure.

With `--device cpu --quick` everything runs on a processor, where recorded operations stand for
graphs; the numbers then mean nothing.
"""

import argparse
import dataclasses
import datetime
import json
import sys
import time
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch

from benchmarks import learner_paths, run
from benchmarks.gpu_paths import FAILED, captures, draws, twins
from benchmarks.gpu_rates import TARGETS, rates
from benchmarks.model_free import PEER
from benchmarks.records import Results, Row
from benchmarks.settings import Settings

__all__ = ["UNITS", "main"]

_LONGEST = 120.0  # seconds of a check; then it is stopped


def _units() -> dict[str, run.Unit]:
    units: dict[str, run.Unit] = {"draws": draws, "twins": twins, "captures": captures}
    for name in dict.fromkeys(name for name, _ in TARGETS):
        units[name] = partial(rates, name)
        if name in learner_paths.IN_JAX:
            units[f"{name}-jax"] = partial(learner_paths.beside_jax, name)
    return units


UNITS: Mapping[str, run.Unit] = _units()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu_check", description=__doc__)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:NUMBER, or cpu with --quick")
    parser.add_argument("--threads", type=int, default=2, help="of every process")
    parser.add_argument("--minutes", type=float, default=8.0, help="after which nothing begins")
    parser.add_argument("--only", nargs="+", choices=UNITS, metavar="NAME", help=", ".join(UNITS))
    parser.add_argument("--quick", action="store_true", help="tiny sizes, for tests")
    parser.add_argument("--peer", type=Path, default=PEER, help="a Python with JAX")
    parser.add_argument("--results", type=Path, default=run.RESULTS, help="folder of both files")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        warnings.simplefilter("ignore", UserWarning)  # lost graphs are told in rows
        run.serve(options.serve[0], Settings(**json.loads(options.serve[1])), UNITS)
        return
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        parser.error("this PyTorch sees no GPU; --device cpu --quick tries the script itself.")
    usual = run.settings_of(options, everything=False)
    settings = dataclasses.replace(usual, only_lanes=(1,) if options.quick else (5, 80))
    results = Results(run.described(settings))
    now = datetime.datetime.now(tz=datetime.UTC)
    path = options.results / f"{now:%Y-%m-%dT%H%M%S}-gpu-check.json"
    end = time.monotonic() + 60.0 * options.minutes
    for name in options.only or list(UNITS):
        left = end - time.monotonic()
        if left <= 0:
            results.rows.append(Row(unit=name, name=name, note="left out: no time was left"))
        else:
            print(f"{name} ...", end="", flush=True)
            found = run.measured(name, settings, min(left, _LONGEST), module="benchmarks.gpu_check")
            results.rows += found
            print(f" {left - (end - time.monotonic()):.0f} s", flush=True)
        results.finished.append(name)
        results.write(path)
    print(f"\n{results.markdown()}\nStored: {path} and {path.with_suffix('.md').name}")
    failed = [row for row in results.rows if row.note.startswith((FAILED, "failed", "stopped"))]
    for row in failed:
        print(f"{row.unit}, {row.name}: {row.note}", file=sys.stderr)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
