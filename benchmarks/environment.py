"""Speed of the Industrial Benchmark: a scalar Python loop against the vectorised environment.

`python -m benchmarks.environment [--copies 1000] [--seconds 2]` prints a table of steps per second.
Both run on one core with actions prepared beforehand; of several repetitions the best counts, since
other work on the computer can only slow a repetition down.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from benchmarks.measure import computer, markdown
from benchmarks.scalar_industrial_benchmark import (
    GeneratorDraws,
    ScalarIndustrialBenchmark,
    TunedScalarIndustrialBenchmark,
)
from components.environments.industrial.benchmark import IndustrialBenchmark

_PREPARED = 64


def best_rate(run: Callable[[], int], seconds: float) -> float:
    """Steps per second of the fastest repetition within a time budget."""
    best, end = 0.0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        begin = time.perf_counter()
        steps = run()
        best = max(best, steps / (time.perf_counter() - begin))
    return best


def scalar_loop(kind: type[ScalarIndustrialBenchmark]) -> Callable[[], int]:
    """A runner of random steps of one machine."""
    rng = np.random.default_rng(0)
    machine = kind(GeneratorDraws(rng))
    machine.reset()
    actions = rng.uniform(-1.0, 1.0, (_PREPARED, 3))

    def run() -> int:
        for action in actions:
            machine.step(action)
        return _PREPARED

    return run


def vectorised(copies: int) -> Callable[[], int]:
    """A runner of random steps of many machines."""
    rng = np.random.default_rng(0)
    machines = IndustrialBenchmark(copies)
    machines.reset(rng)
    actions = rng.uniform(-1.0, 1.0, (_PREPARED, copies, 3))

    def run() -> int:
        for action in actions:
            machines.step(action)
        return _PREPARED * copies

    return run


def report(copies: int = 1000, seconds: float = 2.0) -> str:
    """Measure loops and environments; a Markdown table.

    Args:
        copies: Size of the vectorised environment; some other sizes are measured beside it.
        seconds: Budget of each measurement.
    """
    plain = best_rate(scalar_loop(ScalarIndustrialBenchmark), seconds)
    tuned = best_rate(scalar_loop(TunedScalarIndustrialBenchmark), seconds)
    rates = [("scalar loop, plain", 1, plain), ("scalar loop, tuned", 1, tuned)]
    for size in sorted({1, 10, 100, copies, 10 * copies}):
        rates.append(("vectorised", size, best_rate(vectorised(size), seconds)))
    rows = [
        [name, f"{size:,}", f"{rate:,.0f}", f"{rate / plain:,.1f}", f"{rate / tuned:,.1f}"]
        for name, size, rate in rates
    ]
    columns = ["environment", "copies", "steps per second", "times plain", "times tuned"]
    return markdown(columns, rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.environment", description=__doc__)
    parser.add_argument("--copies", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=2.0, help="budget of each measurement")
    options = parser.parse_args()
    print(report(options.copies, options.seconds))
    print(f"\n{computer()}; one core used, NumPy {np.__version__}")


if __name__ == "__main__":
    main()
