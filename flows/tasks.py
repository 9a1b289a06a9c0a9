"""The components as task functions of the pipeline: read inputs, call the science, write artifacts.

Model fitting has a module of its own, :mod:`flows.fitting`.

Each function gets the nodes of one group. Seeds of one (dataset, algorithm) pair arrive together
and are trained and evaluated as lanes of one program; what a lane computes does not depend on the
others.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from components.aggregation.statistics import pool_policies, summarise
from components.algorithms import ALGORITHMS
from components.algorithms.base import Ingredients
from components.algorithms.train import train_policies
from components.data.catalogue import generate, spec_kind
from components.data.lanes import LaneData
from components.evaluation.real import EvaluationConfig, evaluate_policies
from components.models import MODELS
from components.networks.policy import Policy
from components.networks.streams import lane_key
from flows.fitting import (
    config_object,
    note_dataset,
    open_dataset,
    read_input,
    write_curves,
    write_numbers,
)
from flows.memory import keep_freed_memory
from flows.pipeline.task import Job, TaskContext

__all__ = [
    "aggregate",
    "evaluate",
    "generate_dataset",
    "train",
]


def _inherit_datasets(job: Job, role: str) -> None:
    """A run that judges policies names the dataset these were trained on."""
    listed = job.inputs[role] / "datasets.json"
    (job.out / "datasets.json").write_text(listed.read_text(encoding="utf-8"), encoding="utf-8")


def _percent(lambdas: np.ndarray) -> list[int]:
    """Lambda as the whole-numbered step of a curve."""
    return [round(100 * float(value)) for value in lambdas]


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"{path} is damaged ({error}).") from error


def generate_dataset(jobs: Sequence[Job], context: TaskContext) -> None:
    """Data generation: `dataset/` holds the arrays and the card."""
    for job in jobs:
        dataset = generate(
            spec_kind(job.config["spec"])(**job.config["spec"]),
            job.config["seed"],
            context.threads,
        )
        dataset.write(job.out / "dataset")
        card = dataset.card
        write_numbers(
            job.out / "metrics.json",
            {
                "return/first_window_mean": card.first_window_return_mean,
                "return/first_window_min": card.first_window_return_min,
                "return/first_window_max": card.first_window_return_max,
                "return/all_windows_mean": card.all_windows_return_mean,
                "transitions": dataset.transitions,
            },
        )
        note_dataset(job, dataset)


def train(jobs: Sequence[Job], context: TaskContext) -> None:
    """Policy training: `policy/` holds the snapshots of a run; one lane per job."""
    keep_freed_memory()
    algorithm = jobs[0].config["algorithm"]
    module = ALGORITHMS[algorithm]
    config = config_object(module.Config, jobs[0].config["settings"])
    datasets = [open_dataset(job) for job in jobs]
    data = LaneData(datasets, torch.device(context.device), module.FRAME_EPSILON)
    parts = Ingredients(
        data=data,
        keys=[
            lane_key(d.card.name, algorithm, j.config["seed"])
            for d, j in zip(datasets, jobs, strict=True)
        ],
        models={
            name: [read_input(job, name, MODELS[name].load, "model") for job in jobs]
            for name in module.NEEDS
        },
    )
    policies, curves = train_policies(
        algorithm,
        module.Learner(config, parts),
        datasets,
        [job.key for job in jobs],
        updates=config.updates,
        snapshots=jobs[0].config["snapshots"],
        takes_lambda=module.TAKES_LAMBDA,
        preparation=getattr(config, "preparation", 0),
        work=context.work,
        progress=context.progress,
        device=torch.device(context.device),
    )
    for lane, (job, policy) in enumerate(zip(jobs, policies, strict=True)):
        (job.out / "policy").mkdir()
        policy.save(job.out / "policy")
        write_curves(job.out / "curves.npz", curves.of_lane(lane))
        if policy.card.ended_at is not None:
            write_numbers(job.out / "metrics.json", {"training/ended_at": policy.card.ended_at})
        note_dataset(job, datasets[lane])


def evaluate(jobs: Sequence[Job], context: TaskContext) -> None:
    """Real-environment evaluation: `returns.npz` holds every snapshot's returns."""
    first = jobs[0].config
    config = EvaluationConfig(**first["evaluation"])
    policies = [read_input(job, "policy", Policy.load, "policy") for job in jobs]
    results = evaluate_policies(
        policies,
        [read_input(job, "behaviour_policy", Policy.load, "model") for job in jobs],
        first["environment"],
        first["parameters"],
        config,
        [lane_key("evaluation", *job.config["stream"]) for job in jobs],
        torch.device(context.device),
        context.progress,
        context.threads,
    )
    for job, policy, result in zip(jobs, policies, results, strict=True):
        with (job.out / "returns.npz").open("wb") as file:
            np.savez(
                file,
                lambdas=result.lambdas,
                returns=result.returns,
                distances=result.distances,
                steps=np.asarray(policy.card.steps),
                ended_at=np.asarray([] if policy.card.ended_at is None else [policy.card.ended_at]),
            )
        means = result.returns.mean(axis=-1)  # [S, lambdas]
        curves = {}
        for column, value in enumerate(result.lambdas):
            if np.isnan(value):
                curves["evaluation/return"] = (policy.card.steps, means[:, column])
                curves["evaluation/distance"] = (policy.card.steps, result.distances[:, column])
            elif round(100 * value) % 25 == 0:
                name = f"evaluation/return_at_lambda_{value:.2f}"
                curves[name] = (policy.card.steps, means[:, column])
        if policy.card.takes_lambda:
            percent = _percent(result.lambdas)
            curves["over_lambda/return"] = (percent, means[-1])
            curves["over_lambda/distance"] = (percent, result.distances[-1])
        write_curves(job.out / "curves.npz", curves)
        _inherit_datasets(job, "policy")


def aggregate(jobs: Sequence[Job], context: TaskContext) -> None:
    """Aggregation: `summary.json` holds the statistics of a (dataset, algorithm) pair."""
    for job in jobs:
        seeds = job.config["seeds"]
        stored = []
        for seed in seeds:
            stored.append(read_input(job, f"seed{seed}", _load_arrays, "returns.npz"))
        last = max(1, round(job.config["pool_fraction"] * len(stored[0]["returns"])))
        pool = pool_policies([s["returns"] for s in stored], last)  # [seeds * last, lambdas]
        per_seed = pool.reshape(len(seeds), last, -1).mean(axis=1)
        distances = np.stack([s["distances"][-last:] for s in stored]).mean(axis=(0, 1))
        points = []
        for column, value in enumerate(stored[0]["lambdas"]):
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
        summary = {
            "dataset": job.config["dataset"],
            "algorithm": job.config["algorithm"],
            "seeds": seeds,
            "ended_at": ended,  # seeds whose loss became infinite or undefined, and when
            "points": points,
        }
        write_numbers(job.out / "summary.json", summary)
        shown = ("tenth_percentile", "standard_error", "mean", "std", "iqm", "distance")
        if points[0]["lambda"] is None:
            write_numbers(job.out / "metrics.json", {name: points[0][name] for name in shown})
        else:
            percent = _percent(stored[0]["lambdas"])
            curves = {f"over_lambda/{n}": (percent, [p[n] for p in points]) for n in shown}
            write_curves(job.out / "curves.npz", curves)
        _inherit_datasets(job, f"seed{seeds[0]}")
