"""What every node and every command pays: overhead of the pipeline, time to the first node."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks import pipeline
from benchmarks.records import Row, row_of_seconds
from benchmarks.settings import Settings

__all__ = ["node_overhead", "start_up"]

_ROOT = Path(__file__).resolve().parents[1]


def node_overhead(settings: Settings) -> Iterator[Row]:
    """What the pipeline adds to a node that does nothing."""
    nodes = 4 if settings.quick else 40
    found: dict[str, list[float]] = {}
    for _ in range(settings.repetitions):
        for name, seconds in pipeline.seconds_per_plan(nodes, 1).items():
            found.setdefault(name, []).append(seconds / nodes)
    with tempfile.TemporaryDirectory() as folder:
        floor = min(settings.timings(partial(_three_files, Path(folder))))
    for name, timings in found.items():
        made = name.startswith("computed")
        yield row_of_seconds(
            "pipeline, per empty node",
            name,
            timings,
            measure="ms",
            floor=floor if made else None,
            bound="writing and renaming its files",
        )


def _three_files(folder: Path) -> None:
    """The least that a node leaves: two files, its record, and a rename."""
    work, done = folder / "work", folder / "done"
    work.mkdir()
    for name in ("metrics.json", "datasets.json", "node.json"):
        (work / name).write_text("{}")
    work.rename(done)
    shutil.rmtree(done)


def start_up(settings: Settings) -> Iterator[Row]:
    """From the command to the first node that begins: imports, plan, database, executor."""
    for executor, repeats in (("serial", settings.repetitions), ("ray", 1)):
        if settings.quick and executor == "ray":
            continue
        imported = "torch, mlflow" + (", ray" if executor == "ray" else "")
        command = [sys.executable, "-c", f"import {imported}"]
        imports = partial(subprocess.run, command, check=True)
        timings, floor = [], min(settings.once(imports) for _ in range(repeats + 1))
        for _ in range(repeats):
            with tempfile.TemporaryDirectory() as folder:
                timings.append(_until_first_node(Path(folder), executor))
        name = f"smoke profile, {executor} executor"
        yield row_of_seconds(
            "seconds until the first node starts",
            name,
            timings,
            floor=floor,
            bound=f"importing {imported}",
        )


def _until_first_node(folder: Path, executor: str) -> float:
    """Seconds until the store has a work folder; the run then goes on to its end."""
    plan = ("profile=smoke", "datasets=[mediocre-0.2]", "algorithms=[bc]")
    command = [sys.executable, "-m", "flows.full_benchmark", *plan]
    command += [f"runner.executor={executor}", f"store={folder / 'store'}"]
    own = {name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"}
    own["OMP_WAIT_POLICY"] = "PASSIVE"
    with (folder / "errors").open("w+") as errors:
        begin = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=_ROOT, env=own, stdout=subprocess.DEVNULL, stderr=errors
        )
        taken, work = None, folder / "store" / "work"
        while process.poll() is None:
            if taken is None and work.is_dir() and any(work.iterdir()):
                taken = time.perf_counter() - begin
            time.sleep(0.005 if taken is None else 0.1)
        if process.returncode or taken is None:
            errors.seek(0)
            last = (errors.read().strip() or "no message").splitlines()[-1]
            raise RuntimeError(f"the run ended with exit code {process.returncode}: {last}")
    return taken
