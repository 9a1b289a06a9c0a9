"""Speed of stacked seeds: five lanes in one program against five programs of one lane.

`python -m benchmarks.lanes [--device cpu] [--repetitions 3]`. Both train at the thesis's sizes on
the same dataset; the five programs take turns, update by update, in one process, so neither
start-up nor loading counts against them. On a GPU both replay their updates as CUDA graphs, and a
third row runs without graphs. LION's behaviour policy and transition ensemble are not trained:
their weights do not change the amount of work.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from benchmarks.measure import computer, markdown, median_seconds
from benchmarks.recurrent import FATIGUE_ALONE
from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator, lane_key, spawn_generators
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.networks import StackedMLP
from components.policies.policy import Policy, PolicyCard
from components.training.cuda_graphs import BranchingLearner, graphed
from components.training.loop import Learner
from components.training.memory import keep_freed_memory

__all__ = ["UNTRAINED", "program", "report"]

_SEEDS = 5
_MEMBERS, _HIDDEN = 4, 30  # of the transition ensemble
_UPDATES = MappingProxyType({"td3_bc": 20, "lion": 2})  # per timing: about a second or two
_ON_A_GPU = 10  # times as many updates per timing
_DEFAULTS: Mapping[str, Mapping[str, object]] = MappingProxyType({})


def program(
    algorithm: str,
    dataset: OfflineDataset,
    seeds: Sequence[int],
    device: torch.device,
    **settings: object,
) -> BranchingLearner:
    """A fresh learner with one lane per seed.

    Args:
        algorithm: Name of a learner.
        dataset: Shared by the lanes.
        seeds: One per lane.
        device: Where to train.
        settings: Differences from the learner's default configuration.
    """
    record = ALGORITHMS[algorithm]
    inputs = LearnerInputs(
        data=LaneData([dataset] * len(seeds), device, record.frame_epsilon),
        keys=[lane_key(dataset.card.name, algorithm, seed) for seed in seeds],
        models={name: [UNTRAINED[name](dataset)] * len(seeds) for name in record.needs},
    )
    return record.learner(record.config(**settings), inputs)


def _behaviour(dataset: OfflineDataset) -> Policy:
    card = PolicyCard(
        algorithm="behaviour_policy",
        dataset=dataset.card.name,
        features=tuple(dataset.card.frame_features),
        history=dataset.card.history,
        actions=dataset.actions.shape[1],
        takes_proximity=False,
        steps=(0,),
    )
    sizes = (dataset.card.history * dataset.frames.shape[1], 20, dataset.actions.shape[1])
    network = StackedMLP(spawn_generators([0], "behaviour"), sizes)
    scaling = Normaliser.stack([Normaliser.fit(dataset.frames)])
    return Policy.of_networks(card, {"actor": network.affine()}, scaling).lane(0, card)


def _ensemble(dataset: OfflineDataset) -> RecurrentEnsemble:
    rng, bound, cells = lane_generator(0), _HIDDEN**-0.5, 2 * _MEMBERS
    weight = rng.uniform(-bound, bound, (cells, _HIDDEN, _HIDDEN + 6)).astype(np.float32)
    readout = rng.uniform(-bound, bound, (cells, 1, _HIDDEN + 1)).astype(np.float32)
    limit = torch.full((2,), 3.0)
    return RecurrentEnsemble(
        torch.from_numpy(weight),
        torch.from_numpy(readout),
        Normaliser.fit(dataset.frames),
        -limit,
        limit,
        FATIGUE_ALONE,
        dataset.card.history,
    )


UNTRAINED: Mapping[str, Callable[[OfflineDataset], object]] = MappingProxyType(
    {"behaviour_policy": _behaviour, "recurrent_ensemble": _ensemble}
)
"""Untrained models of the usual sizes, by name."""


def _updates(learners: Sequence[Learner], count: int) -> Callable[[], None]:
    """A runner of `count` further updates of every learner, in turn."""
    done = 0

    def run() -> None:
        nonlocal done
        for step in range(done, done + count):
            for learner in learners:
                learner.update(step)
        done += count

    return run


def report(
    device: str = "cpu",
    repetitions: int = 3,
    updates: Mapping[str, int] = _UPDATES,
    trajectories: int = 100,
    settings: Mapping[str, Mapping[str, object]] = _DEFAULTS,
) -> str:
    """Measure both learners; a Markdown table.

    Args:
        device: Where to train.
        repetitions: Timings per row, the median counts.
        updates: Updates per timing and learner, by name.
        trajectories: Of the dataset, 1,000 steps each.
        settings: Differences from the learners' default configurations, by name.
    """
    keep_freed_memory()
    place = torch.device(device)
    dataset = generate(
        IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=trajectories), seed=0
    )
    on_a_gpu = place.type == "cuda"
    rows = []
    for algorithm, few in updates.items():
        own, count = settings.get(algorithm, {}), few * (_ON_A_GPU if on_a_gpu else 1)

        def fresh(*seeds: int, of: str = algorithm, own: Any = own) -> BranchingLearner:
            return program(of, dataset, seeds, place, **own)

        seeds = range(_SEEDS)
        alone, together = (f"{_SEEDS} programs of 1 lane, in turn", f"1 program of {_SEEDS} lanes")
        programs = {
            alone: [graphed(fresh(seed), place) for seed in seeds],
            together: [graphed(fresh(*seeds), place)],
        }
        if on_a_gpu:
            programs[f"{together}, no graphs"] = [fresh(*seeds)]
        runs = {name: _updates(learners, count) for name, learners in programs.items()}
        seconds = median_seconds(runs, repetitions)
        rates = {name: count * _SEEDS / taken for name, taken in seconds.items()}
        for name, rate in rates.items():  # seed-updates per second
            lanes = 1 if name == alone else _SEEDS
            ratio = rate / rates[alone]
            rows.append([algorithm, name, f"{rate / lanes:,.1f}", f"{rate:,.1f}", f"{ratio:.2f}"])
    columns = ["learner", "program", "updates/s of one program", "seed-updates/s", "times"]
    return markdown(columns, rows, texts=2)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lanes", description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    print(report(options.device, options.repetitions))
    print(f"\n{computer(options.device)}")


if __name__ == "__main__":
    main()
