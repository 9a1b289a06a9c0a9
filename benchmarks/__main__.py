"""All speed measurements, one after the other: ``python -m benchmarks``, or ``make bench``."""

from benchmarks import environment, lanes, pipeline, recurrent
from benchmarks.measure import machine

__all__ = ["main"]


def main() -> None:
    """Print the machine and a Markdown table per benchmark, each as soon as it is known."""
    print(machine(), flush=True)
    for title, report in {
        "Industrial Benchmark": environment.report,
        "Five seeds as five lanes": lanes.report,
        "Recurrent transition ensemble": recurrent.report,
        "Pipeline": pipeline.report,
    }.items():
        print(f"\n## {title}\n", flush=True)
        print(report(), flush=True)


if __name__ == "__main__":
    main()
