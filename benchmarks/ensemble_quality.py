"""Time that the recurrent ensemble takes to reference quality on `mediocre-1.0`.

`python -m benchmarks.ensemble_quality [--threads 2]`. The reference artefacts of the thesis's
authors reach a held-out normalised squared error of about 0.040 (fatigue) and 0.005 (consumption),
after about 250 epochs of 81 batches of 1,024 windows for each of eight networks. Here all eight
train at once with the default schedule; the clock stops at the first validation after which the
mean of the best states so far is as good.
"""

import argparse
import itertools
import time
from collections.abc import Sequence

import numpy as np
import torch

from benchmarks.measure import computer, markdown
from components.core.random_streams import lane_key
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from components.models.recurrent_ensemble.fit import fit_recurrent_ensemble
from components.models.supervised import Monitor, Series

__all__ = ["REFERENCE", "first_good", "report"]

REFERENCE = {"fatigue": 0.040, "consumption": 0.005}
DATASET = IndustrialSpec("mediocre-1.0", "mediocre", 1.0)


def first_good(curves: dict[str, Sequence[Series]], wanted: dict[str, float]) -> int | None:
    """The validation, counted from 0, at which every target's mean best loss is low enough.

    Args:
        curves: Held-out losses over the validations, one series per network, by target.
        wanted: Loss to reach by target.
    """
    good = []
    for target, series in curves.items():
        best = np.minimum.accumulate([values for _, values in series], axis=1)
        good.append(best.mean(axis=0) <= wanted[target])
    reached = np.flatnonzero(np.logical_and.reduce(good))
    return int(reached[0]) if reached.size else None


def report(device: str = "cpu", config: RecurrentEnsembleConfig | None = None) -> str:
    """Fit once and say when it was good enough; a Markdown table.

    Args:
        device: Where to train.
        config: The default configuration if None.
    """
    sizes = config or RecurrentEnsembleConfig()
    dataset = generate(DATASET, 0)
    begin = time.perf_counter()
    moments: list[float] = []
    watch = Monitor(validated=lambda fraction, loss: moments.append(time.perf_counter() - begin))
    fit = fit_recurrent_ensemble(
        dataset,
        sizes,
        lane_key(DATASET.name, "recurrent_ensemble", 0),
        torch.device(device),
        None,
        watch,
    )
    whole = time.perf_counter() - begin
    names = itertools.product(REFERENCE, range(sizes.members))
    curves: dict[str, list[Series]] = {target: [] for target in REFERENCE}
    for target, member in names:
        curves[target].append(fit.curves[f"model/validation_mse/{target}{member}"])
    reached = first_good(dict(curves), REFERENCE)
    rows = []
    for target, wanted in REFERENCE.items():
        rows.append([target, f"{wanted:.4f}", f"{fit.metrics[f'validation_mse/{target}']:.4f}"])
    table = markdown(["held-out normalised MSE", "reference", "here, at the end"], rows)
    when = "not reached" if reached is None else f"reached after {moments[reached]:,.0f} s"
    return (
        f"{table}\n\nReference quality {when}; the whole fit took {whole:,.0f} s "
        f"({sizes.updates:,} updates of {2 * sizes.members} networks)."
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ensemble_quality", description=__doc__
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(report(options.device))
    print(f"\n{computer(options.device)}")


if __name__ == "__main__":
    main()
