"""Tables of speed, one after the other, for many minutes: ``python -m benchmarks``."""

import argparse

from benchmarks import (
    ensemble_quality,
    environment,
    experts,
    lanes,
    model_free,
    pipeline,
    recurrent,
    robots,
    wsbc,
)
from benchmarks.measure import computer

__all__ = ["main"]


def main() -> None:
    """Print a line about the computer and a Markdown table per benchmark, each when it is known."""
    argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__).parse_args()
    print(computer(), flush=True)
    reports = {
        "Industrial Benchmark": environment.report,
        "Robots": robots.report,
        "Five seeds as five lanes": lanes.report,
        "Recurrent transition ensemble": recurrent.report,
        "Time to a reference-quality ensemble": ensemble_quality.report,
        "A swarm of policies": wsbc.report,
        "Four experts in training": experts.report,
        "Pipeline": pipeline.report,
    }
    if beside := model_free.available():
        reports["Model-free learners beside d3rlpy"] = model_free.report
    for title, report in reports.items():
        print(f"\n## {title}\n", flush=True)
        print(report(), flush=True)
    if not beside:
        print(f"\nSkipped the comparison with d3rlpy. {model_free.missing()}")


if __name__ == "__main__":
    main()
