"""Model fitting as a task function, and what all task functions share to read inputs and write.

Hyperparameter search runs this module in its workers. It therefore imports no environment, no
evaluation and no algorithm, and neither does anything it imports: an import contract and a test
hold it to that.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.models.supervised import Monitor
from components.networks.streams import lane_key
from flows.pipeline.task import Job, TaskContext

__all__ = [
    "config_object",
    "fit_model",
    "note_dataset",
    "open_dataset",
    "read_input",
    "write_curves",
    "write_numbers",
]

T = TypeVar("T")


def write_numbers(path: Path, value: Any) -> None:
    """Write a JSON file of an artifact that is still being made."""
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def write_curves(path: Path, curves: Mapping[str, tuple[Sequence[int], Sequence[float]]]) -> None:
    """Write learning curves as the pipeline reads them: two arrays per name."""
    arrays = {}
    for name, (steps, values) in curves.items():
        arrays[f"{name}/step"] = np.asarray(steps, dtype=np.int64)
        arrays[f"{name}/value"] = np.asarray(values, dtype=np.float64)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def read_input(job: Job, role: str, reader: Callable[[Path], T], name: str) -> T:
    """Read an input; a damaged one is named with its remedy.

    Raises:
        ValueError: The input is damaged.
    """
    folder = job.inputs[role]
    try:
        return reader(folder / name)
    except (ValueError, FileNotFoundError) as error:
        raise ValueError(
            f"{error} To have it rebuilt, delete {folder} and give the same command again."
        ) from error


def open_dataset(job: Job) -> OfflineDataset:
    """The dataset a job reads."""
    return read_input(job, "dataset", OfflineDataset.open, "dataset")


def note_dataset(job: Job, dataset: OfflineDataset) -> None:
    """Record which dataset an artifact is about."""
    card = dataset.card
    entry = {"name": card.name, "digest": card.digest[:32], "source": card.environment}
    write_numbers(job.out / "datasets.json", [entry])


def config_object(kind: type, fields: Mapping[str, Any]) -> Any:
    """A configuration object from JSON, where tuples have become lists."""
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})


def fit_model(jobs: Sequence[Job], context: TaskContext) -> None:
    """Model fitting: `model/` holds the fitted model of the job's kind."""
    for job in jobs:
        kind = MODELS[job.config["model"]]
        dataset = open_dataset(job)
        fit = kind.fit(
            dataset,
            config_object(kind.config, job.config["settings"]),
            lane_key(dataset.card.name, job.config["model"], job.config["seed"]),
            torch.device(context.device),
            context.work / f"{job.key}.safetensors",
            Monitor(context.progress, context.validated),
        )
        (job.out / "model").mkdir()
        fit.model.save(job.out / "model")
        loss = {"validation_loss": fit.validation_loss}
        write_numbers(job.out / "metrics.json", loss | dict(fit.metrics))
        write_curves(job.out / "curves.npz", fit.curves)
        note_dataset(job, dataset)
