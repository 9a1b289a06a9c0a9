"""Aggregation as a task function: from the returns of all seeds to the numbers of a table."""

from collections.abc import Sequence

import numpy as np

from components.aggregation.statistics import pool_policies, pooled_snapshots, summarise
from components.core.arrays import load_arrays
from components.core.files import without_undefined
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    inherit_datasets,
    percent,
    read_input,
    write_curves,
    write_numbers,
)

__all__ = ["aggregate"]


def aggregate(jobs: Sequence[Job], context: TaskContext) -> None:
    """Aggregation: `summary.json` holds the statistics of a (dataset, algorithm) pair."""
    for job in jobs:
        seeds = job.config["seeds"]
        stored = []
        for seed in seeds:
            stored.append(read_input(job, f"seed{seed}", load_arrays, "returns.npz"))
        last = pooled_snapshots(len(stored[0]["returns"]), job.config["pool_fraction"])
        pool = pool_policies([s["returns"] for s in stored], last)  # [seeds * last, N]
        per_seed = pool.reshape(len(seeds), last, -1).mean(axis=1)
        distances = np.stack([s["distances"][-last:] for s in stored]).mean(axis=(0, 1))
        points = []
        proximities = stored[0]["lambdas"]  # [N], under the name in stored files
        for column, value in enumerate(proximities):
            statistics = summarise(pool[:, column]).as_dict()
            spread = float(per_seed[:, column].std(ddof=1)) if len(seeds) > 1 else 0.0
            points.append(
                {
                    "lambda": None if np.isnan(value) else float(value),
                    **statistics,
                    "seed_std": spread,
                    "distance": float(distances[column]),
                }
            )
        ended = {
            str(n): int(s["ended_at"][0])
            for n, s in zip(seeds, stored, strict=True)
            if s["ended_at"].size
        }
        undefined = {
            str(n): sum(int((~np.isfinite(s[of][-last:])).sum()) for of in ("returns", "distances"))
            for n, s in zip(seeds, stored, strict=True)
        }
        summary = {
            "dataset": job.config["dataset"],
            "algorithm": job.config["algorithm"],
            "seeds": seeds,
            "ended_at": ended,  # seeds whose loss became infinite or undefined, and when
            "points": points,
        }
        if any(undefined.values()):  # seeds with numbers that are not finite, and how many
            summary["undefined"] = {seed: count for seed, count in undefined.items() if count}
        write_numbers(job.out / "summary.json", without_undefined(summary))
        shown = ("tenth_percentile", "standard_error", "mean", "std", "iqm", "distance")
        if points[0]["lambda"] is None:
            numbers = {name: points[0][name] for name in shown}
            write_numbers(job.out / "metrics.json", without_undefined(numbers))
        else:
            steps = percent(proximities)
            curves = {f"over_proximity/{n}": (steps, [p[n] for p in points]) for n in shown}
            write_curves(job.out / "curves.npz", curves)
        inherit_datasets(job, f"seed{seeds[0]}")
