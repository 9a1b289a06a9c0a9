"""All hot paths, each with its peer and its floor: ``python -m benchmarks.run``, or ``make bench``.

`[--device cpu] [--threads N] [--only NAME ...] [--quick] [--all] [--resume FILE.json] [--list]`. A
dozen minutes on two quiet cores; with `--all` also 80 lanes on a CPU and all that takes long. Every
benchmark is a process of its own, one after the other, so that one which fails, dies or hangs
becomes a row that says so. After each of them the results are stored, as a JSON and a Markdown file
under `benchmarks/results/`; `--resume` goes on with a run that was stopped.

Peers need `make peers`; where it was not given, their rows say so. Ours and theirs get the same
number of threads: PyTorch by its own setting, JAX, which has none, by the processors it may use.
"""

import argparse
import dataclasses
import datetime
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch

from benchmarks import learner_paths, paths, pipeline_paths
from benchmarks.floors import Limits
from benchmarks.measure import processor
from benchmarks.model_free import PEER
from benchmarks.peer_d3rlpy import COUNTERPARTS
from benchmarks.records import Results, Row
from benchmarks.settings import Settings
from components.algorithms import ALGORITHMS
from components.models import MODELS
from components.training.memory import keep_freed_memory
from flows.pipeline.computer import set_precision
from flows.pipeline.signals import ending_signals, exit_code

__all__ = ["RESULTS", "UNITS", "Unit", "described", "main", "measured", "serve", "settings_of"]

RESULTS = Path(__file__).with_name("results")
_MARK = "row: "
_LONGEST = 300.0  # seconds of a benchmark; then it is stopped

_TOGETHER = ("bc", "td3_bc", "cql", "lion")  # a small update, two usual ones and roll-outs

Unit = Callable[[Settings], Iterator[Row]]


def _together(settings: Settings) -> Iterator[Row]:
    """Rows of learners as sweeps run them: five lanes, a thread each, in a process per core."""
    count = settings.threads
    own = dataclasses.replace(
        settings,
        threads=1,
        processes=count,
        only_lanes=(1 if settings.quick else 5,),
        seconds=2 * settings.seconds,  # so that the processes meet
        matrix_rate=settings.matrix_rate / count,
        bandwidth=settings.bandwidth / count,
    )
    for name in _TOGETHER[: 1 if settings.quick else None]:
        with ThreadPoolExecutor(count) as pool:
            found = list(
                pool.map(lambda _, name=name: measured(name, own, inner=True)[-1], range(count))
            )
        slowest = min(found, key=lambda row: row.value or 0.0)
        label = f"{slowest.name}, {count} processes of one thread"
        note = slowest.note or "per process, the slowest"
        yield dataclasses.replace(slowest, unit="side by side", name=label, note=note)


def _units() -> dict[str, Unit]:
    """All benchmarks by name, the quick ones first."""
    units: dict[str, Unit] = {
        "industrial": paths.industrial,
        "robots": paths.robot_rollouts,
        "dataset": paths.dataset_load,
        "pipeline": pipeline_paths.node_overhead,
        "start": pipeline_paths.start_up,
        "evaluation": paths.evaluation,
        "recurrent": paths.recurrent_pass,
        "together": _together,
    }
    units |= {f"fit-{kind}": partial(paths.fit, kind) for kind in MODELS}
    for name in ALGORITHMS:
        units[name] = partial(learner_paths.updates, name)
        if name in COUNTERPARTS:
            units[f"{name}-d3rlpy"] = partial(learner_paths.beside_d3rlpy, name)
        if name in learner_paths.IN_JAX:
            units[f"{name}-jax"] = partial(learner_paths.beside_jax, name)
        if name == "wsbc":
            units["wsbc-plain"] = paths.swarm_peer
    return units


UNITS: Mapping[str, Unit] = _units()


def serve(name: str, settings: Settings, units: Mapping[str, Unit] = UNITS) -> None:
    """Measure one benchmark in this process; print a line of JSON per row."""
    beside = name.endswith(("-d3rlpy", "-jax"))
    # threads of ours would wait for work by spinning, and disturb a peer
    torch.set_num_threads(1 if beside else settings.threads)
    keep_freed_memory()
    if settings.on_a_gpu:
        torch.cuda.set_device(settings.place)
        set_precision("cuda", "high")  # as trainings do by default
    for row in units[name](settings):
        print(_MARK + json.dumps(dataclasses.asdict(row)), flush=True)


def measured(
    name: str,
    settings: Settings,
    longest: float = _LONGEST,
    *,
    inner: bool = False,
    module: str = "benchmarks.run",
) -> list[Row]:
    """Rows of a benchmark, measured in a process of its own; of a failure one that says so.

    Args:
        name: Of the benchmark.
        settings: How to measure.
        longest: Seconds after which it is stopped, with all that it has started.
        inner: Whether another benchmark asks for it, with which it is to be stopped.
        module: Whose `--serve` measures it.
    """
    if name.endswith(("-d3rlpy", "-jax")) and not Path(settings.peer).is_file():
        return [Row(unit=name, name=name, note="left out: `make peers` installs its peer")]
    command = [sys.executable, "-m", module, "--serve", name]
    command.append(json.dumps(dataclasses.asdict(settings)))
    own = os.environ | {"OMP_NUM_THREADS": str(settings.threads), "OMP_WAIT_POLICY": "ACTIVE"}
    root = Path(__file__).resolve().parents[1]
    process = subprocess.Popen(
        command,
        cwd=root,
        env=own,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=not inner,
    )
    stop = process.kill if inner else partial(os.killpg, process.pid, signal.SIGKILL)
    reason = ""
    try:
        out, errors = process.communicate(timeout=longest)
        if process.returncode:
            last = (errors.strip() or "no message").splitlines()[-1]
            reason = f"failed with exit code {process.returncode}: {last}"
    except subprocess.TimeoutExpired:
        stop()
        out, errors = process.communicate()
        reason = f"stopped after {longest:.0f} s"
    except BaseException:
        stop()
        raise
    lines = [line[len(_MARK) :] for line in out.splitlines() if line.startswith(_MARK)]
    rows = [Row(**json.loads(line)) for line in lines]
    if reason or not rows:
        reason = (reason or "ended without a row").replace(str(root), ".")
        reason = reason.replace(str(Path.home()), "~").replace("|", "/")
        rows.append(Row(unit=rows[-1].unit if rows else name, name=name, note=reason))
    return rows


def _commit() -> str:
    """The commit that is measured, marked where files differ from it."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        root = Path(__file__).resolve().parents[1]
        found = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()


def described(settings: Settings) -> dict[str, object]:
    names = ("torch", "numpy", "mujoco", "gymnasium", "ray", "mlflow")
    described: dict[str, object] = {
        "date": datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="minutes"),
        "processor": f"{processor()}, {os.cpu_count()} cores, {settings.threads} thread(s) used",
    }
    if settings.on_a_gpu:
        described["GPU"] = torch.cuda.get_device_name(settings.device)
    described |= {
        "device": settings.device,
        "model": processor(),
        "commit": _commit(),
        "versions": ", ".join(
            [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in names)]
        ),
        "matrix products": f"{settings.matrix_rate / 1e9:,.0f} GFLOP/s (float32 inputs, measured)",
        "bandwidth": f"{settings.bandwidth / 1e9:,.1f} GB/s (copy, measured)",
        "load before": f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown",
    }
    if settings.quick:
        described["quick"] = "sizes for tests; the numbers mean nothing"
    return described


def _differs(old: Mapping[str, object], new: Mapping[str, object]) -> str:
    """What results of both cannot stand in one table for; empty if they can."""
    names = ("processor", "GPU", "device", "versions", "commit", "quick")
    changed = [name for name in names if old.get(name) != new.get(name)]
    return f"{changed[0]} {old.get(changed[0], 'unknown')}" if changed else ""


def settings_of(options: argparse.Namespace, everything: bool) -> Settings:
    torch.set_num_threads(options.threads)
    limits = Limits.measured(torch.device(options.device), options.quick)
    torch.set_num_threads(1)  # nothing is computed here any more
    quick = {"seconds": 0.02, "repetitions": 2} if options.quick else {}
    return Settings(
        device=options.device,
        threads=options.threads,
        everything=everything,
        quick=options.quick,
        peer=str(options.peer.absolute()),  # not resolved: the link makes it an environment
        matrix_rate=limits.matrix_rate,
        bandwidth=limits.bandwidth,
        **quick,
    )


def _measure(names: Sequence[str], settings: Settings, results: Results, path: Path) -> None:
    """Measure what is not finished yet, and store the results after each benchmark."""
    for name in names:
        if name in results.finished:
            continue
        begin = time.perf_counter()
        print(f"{name} ...", end="", flush=True)
        results.rows += measured(name, settings, _LONGEST * (4 if settings.everything else 1))
        results.finished.append(name)
        results.write(path)
        print(f" {time.perf_counter() - begin:.0f} s", flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:NUMBER")
    parser.add_argument("--threads", type=int, default=usable, help="of every process")
    parser.add_argument("--only", nargs="+", choices=UNITS, metavar="NAME", help="see --list")
    parser.add_argument("--list", action="store_true", help="print the names of all benchmarks")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, for tests")
    parser.add_argument(
        "--all", action="store_true", help="80 lanes on a CPU too, nothing left out"
    )
    parser.add_argument("--peer", type=Path, default=PEER, help="a Python with d3rlpy and JAX")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the two files")
    parser.add_argument("--resume", type=Path, metavar="FILE.json", help="a run that was stopped")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.serve[0], Settings(**json.loads(options.serve[1])))
        return
    if options.list:
        print("\n".join(UNITS))
        return
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        parser.error("this PyTorch sees no GPU; leave out --device.")
    if options.threads < 1:
        parser.error(f"--threads is {options.threads}; give at least 1.")
    try:
        old = Results.read(options.resume) if options.resume else None
    except ValueError as error:
        parser.error(str(error))
    settings = settings_of(options, options.all)
    computer = described(settings)
    if old is not None and (changed := _differs(old.computer, computer)):
        parser.error(f"{options.resume} was begun with {changed}; give the same, or begin anew.")
    results = old or Results(computer)
    now = datetime.datetime.now(tz=datetime.UTC)
    kind = settings.place.type + ("-quick" if options.quick else "")
    path = options.resume or options.results / f"{now:%Y-%m-%dT%H%M%S}-{kind}.json"
    try:
        with ending_signals():
            _measure(options.only or list(UNITS), settings, results, path)
    except KeyboardInterrupt:
        begun = f"; --resume {path} goes on" if results.finished else ""
        print(f"\nStopped{begun}.", file=sys.stderr)
        raise SystemExit(exit_code()) from None
    print(f"\n{results.markdown()}\nStored: {path} and {path.with_suffix('.md').name}")


if __name__ == "__main__":
    main()
