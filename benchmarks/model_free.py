"""The model-free learners against d3rlpy: updates per second of one seed, and of five stacked.

`python -m benchmarks.model_free [--peer .venv-peers/bin/python] [--threads 2] [--repetitions 3]`,
ten minutes or more. `make peers` installs d3rlpy. It pins a Gymnasium older than this project's and
therefore lives in an environment of its own; so every measurement, ours too, is a process of its
own, one after the other: one lane, five lanes, d3rlpy, and again. All get the same threads, the
same allocator settings, the same transitions, layers, batch and sample sizes, and only the steady
state is timed: past the warm-ups of BEAR and CQL.

A step of d3rlpy is what its `fit` does without logger and progress bar. It samples from a table of
stacked histories, ours gathers them from the frames. Both draw random numbers, ours for some steps
at once: the clock starts with such a draw, so ours pays for at least as many as it uses.
Where the two implement an algorithm differently, each keeps its own way: d3rlpy's CQL bootstraps
from the mean action, and its BEAR updates a temperature that is switched off.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from benchmarks.lanes import program
from benchmarks.measure import computer, markdown
from benchmarks.peer_d3rlpy import COUNTERPARTS
from components.algorithms import ALGORITHMS
from components.core.random_streams import BLOCK
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.training.memory import keep_freed_memory

__all__ = [
    "PEER",
    "available",
    "missing",
    "own_command",
    "own_seconds",
    "peer_command",
    "report",
    "run",
    "table",
    "write_transitions",
]

_ROOT = Path(__file__).resolve().parents[1]
PEER = _ROOT / ".venv-peers" / "bin" / "python"
SEEDS = 5

WARM_UP = 10  # updates before the clock starts
_UPDATES = MappingProxyType(  # per timing, 5 to 10 s each: one lane, five lanes, d3rlpy
    {
        "ddpg": (1000, 300, 600),
        "bcq": (250, 50, 200),
        "bear": (150, 30, 100),
        "cql": (50, 10, 40),
        "td3_bc": (1000, 300, 600),
    }
)
_DEFAULTS: Mapping[str, object] = MappingProxyType({})


def available(peer: Path = PEER) -> bool:
    """Whether `peer` is a Python that has d3rlpy."""
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec('d3rlpy') is None)"
    try:
        return subprocess.run([peer, "-I", "-c", look], check=False).returncode == 0
    except OSError:
        return False


def missing(peer: Path = PEER) -> str:
    """How to install d3rlpy where it is missing."""
    return f"There is no Python with d3rlpy at {peer}; `make peers` installs one in .venv-peers."


def write_transitions(dataset: OfflineDataset, epsilon: float, path: Path) -> None:
    """Store transitions as the peers want them, every observation a whole normalised history.

    Args:
        dataset: What to store.
        epsilon: Added to the feature deviations, as our learner does.
        path: An .npz file.
    """
    every = torch.arange(dataset.transitions)[None]
    data = LaneData([dataset], torch.device("cpu"), epsilon)
    np.savez(
        path,
        observations=data.observations(every)[0].numpy(),
        actions=dataset.actions,
        rewards=dataset.rewards,
        next_observations=data.batch(every).next_observations[0].numpy(),
        terminals=dataset.terminated,
        ends=dataset.terminated | dataset.truncated,
    )


def own_seconds(
    algorithm: str,
    dataset: OfflineDataset,
    lanes: int,
    updates: int,
    settings: Mapping[str, object] = _DEFAULTS,
) -> float:
    """Seconds of updates of our learner on all lanes, in this process.

    Args:
        algorithm: Name.
        dataset: To learn from.
        lanes: Number of seeds.
        updates: How many; the first of them begins a block of random numbers.
        settings: Differences from the default configuration.
    """
    learner = program(algorithm, dataset, range(lanes), torch.device("cpu"), **settings)
    middle = ALGORITHMS[algorithm].config(**settings).updates // 2  # past every warm-up
    first = (middle // BLOCK + 1) * BLOCK
    for step in range(first - WARM_UP, first):
        learner.update(step)
    begin = time.perf_counter()
    for step in range(first, first + updates):
        learner.update(step)
    return time.perf_counter() - begin


def _serve(request: Mapping[str, Any]) -> None:
    """Measure what another process requests; print the answer as a line of JSON."""
    torch.set_num_threads(request["threads"])
    keep_freed_memory()
    dataset = OfflineDataset.open(Path(request["dataset"]))
    seconds = own_seconds(request["algorithm"], dataset, request["lanes"], request["updates"])
    print(json.dumps({"seconds": seconds, "torch": torch.__version__}))


def own_command(dataset: Path, algorithm: str, lanes: int, updates: int, threads: int) -> list[str]:
    """The command that measures our learner, with its default settings, on a stored dataset."""
    request = {
        "dataset": str(dataset),
        "algorithm": algorithm,
        "lanes": lanes,
        "updates": updates,
        "threads": threads,
    }
    return [sys.executable, "-m", "benchmarks.model_free", "--ours", json.dumps(request)]


def peer_command(peer: Path, data: Path, algorithm: str, updates: int, threads: int) -> list[str]:
    """The command that measures d3rlpy, with our default settings, on stored transitions."""
    settings = {"algorithm": algorithm, **asdict(ALGORITHMS[algorithm].config())}
    script = Path(__file__).with_name("peer_d3rlpy.py")
    counts = {"--threads": threads, "--updates": updates, "--warm-up": WARM_UP}
    options = [str(word) for pair in counts.items() for word in pair]
    return [str(peer), "-I", str(script), str(data), json.dumps(settings), *options]


def run(command: Sequence[str], threads: int) -> dict[str, Any]:
    """Run one measurement in a process of its own; what its last line says.

    Args:
        command: What to run, in the project's folder.
        threads: OpenMP threads. Freed memory stays in the process, as in our trainings.

    Raises:
        RuntimeError: The process failed.
    """
    environment = os.environ | {
        "OMP_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "ACTIVE",  # one process at a time: no other to disturb by spinning
        "MALLOC_TRIM_THRESHOLD_": str(2**31 - 1),
        "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    }
    done = subprocess.run(
        command, cwd=_ROOT, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        reason = (done.stderr.strip() or "no message").splitlines()[-1]
        raise RuntimeError(f"{command[0]} failed with exit code {done.returncode}: {reason}")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def table(
    seconds: Mapping[str, Sequence[Sequence[float]]],
    updates: Mapping[str, Sequence[int]],
    peer: str,
) -> str:
    """A Markdown table.

    Args:
        seconds: Timings by algorithm: of one lane, of five lanes, of the peer.
        updates: Updates per timing, likewise.
        peer: Its name and version.
    """
    programs = {"ours, 1 lane": 1, f"ours, {SEEDS} lanes": SEEDS, f"{peer}, 1 seed": 1}
    rows = []
    for algorithm, timings in seconds.items():
        counts = zip(updates[algorithm], timings, strict=True)
        rates = [count / statistics.median(several) for count, several in counts]
        for (name, lanes), rate in zip(programs.items(), rates, strict=True):
            cells = [f"{rate:,.1f}", f"{rate * lanes:,.1f}", f"{rate * lanes / rates[-1]:.2f}"]
            rows.append([algorithm, name, *cells])
    columns = ["algorithm", "program", "updates/s", "seed-updates/s", "times d3rlpy"]
    return markdown(columns, rows, texts=2)


def report(
    peer: Path = PEER,
    threads: int = 2,
    repetitions: int = 3,
    algorithms: Sequence[str] = tuple(COUNTERPARTS),
    trajectories: int = 20,
) -> str:
    """Measure all; a Markdown table.

    Args:
        peer: A Python that has d3rlpy.
        threads: Of every process.
        repetitions: Timings per row, the median counts.
        algorithms: Names.
        trajectories: Of the dataset, 1,000 steps each.

    Raises:
        FileNotFoundError: There is no peer.
        RuntimeError: A measurement failed.
        ValueError: Less than one thread or repetition.
    """
    if not available(peer):
        raise FileNotFoundError(missing(peer))
    if min(threads, repetitions) < 1:
        raise ValueError("threads and repetitions must be at least 1.")
    dataset = generate(
        IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=trajectories), seed=0
    )
    seconds: dict[str, list[list[float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder, arrays = Path(name) / "dataset", Path(name) / "transitions.npz"
        dataset.write(folder)
        for algorithm in algorithms:
            write_transitions(dataset, ALGORITHMS[algorithm].frame_epsilon, arrays)
            one, five, other = _UPDATES[algorithm]
            commands = [
                own_command(folder, algorithm, 1, one, threads),
                own_command(folder, algorithm, SEEDS, five, threads),
                peer_command(peer, arrays, algorithm, other, threads),
            ]
            answers = [[run(c, threads) for c in commands] for _ in range(repetitions)]
            seconds[algorithm] = [
                [answer["seconds"] for answer in several] for several in zip(*answers, strict=True)
            ]
            ours, theirs = answers[0][0], answers[0][-1]
    return table(seconds, _UPDATES, theirs["program"]) + (
        f"\n\n{threads} thread(s) per process, {dataset.transitions:,} transitions, "
        f"PyTorch {ours['torch']} (ours) and {theirs['torch']} (d3rlpy)."
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.model_free", description=__doc__)
    parser.add_argument("--peer", type=Path, default=PEER, help="a Python that has d3rlpy")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--algorithms", nargs="+", choices=COUNTERPARTS, default=[*COUNTERPARTS])
    parser.add_argument("--ours", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.ours is not None:
        _serve(options.ours)
        return
    peer = options.peer.absolute()  # not resolved: the link is what makes it an environment
    try:
        print(report(peer, options.threads, options.repetitions, options.algorithms))
    except (FileNotFoundError, RuntimeError, ValueError) as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    torch.set_num_threads(options.threads)  # for the line about the computer
    print(f"\n{computer()}")


if __name__ == "__main__":
    main()
