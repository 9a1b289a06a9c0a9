"""Model fitting as a task function.

Hyperparameter search runs this module in its workers. It therefore imports no environment, no
evaluation and no algorithm, and neither does anything it imports: an import contract and a test
hold it to that.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from components.core.files import without_undefined
from components.core.random_streams import lane_key
from components.core.tensors import load_tensors
from components.models import MODELS
from components.models.supervised import Fit, Monitor
from components.training.divergence import DivergedError
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    note_dataset,
    noting_lost_graphs,
    open_dataset,
    write_curves,
    write_numbers,
)
from flows.tasks.divergence import diverged

__all__ = ["fit_model"]


def fit_model(jobs: Sequence[Job], context: TaskContext) -> None:
    """Model fitting: `model/` holds the fitted model of the job's kind."""
    for job in jobs:
        kind = MODELS[job.config["model"]]
        dataset = open_dataset(job)
        try:
            with noting_lost_graphs([job]):
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
            _check_finite(fit, job.out / "model")
        except DivergedError as error:
            section, settings = f"model.{job.config['model']}", job.config["settings"]
            what = f"The fit of {job.config['model']} on {dataset.card.name}"
            job.fail(diverged(what, error, section, settings))
            continue
        metrics = {"validation_loss": fit.validation_loss} | dict(fit.metrics)
        if fit.ended_at is not None:
            metrics["training/ended_at"] = fit.ended_at
        write_numbers(job.out / "metrics.json", without_undefined(metrics))
        write_curves(job.out / "curves.npz", fit.curves)
        note_dataset(job, dataset)


def _check_finite(fit: Fit[Any], stored: Path) -> None:
    """Refuse a fit whose loss, or anything that was stored of its model, is not finite.

    Raises:
        DivergedError: Saying what is not finite.
    """
    if not math.isfinite(fit.validation_loss):
        raise DivergedError(f"its held-out loss is {fit.validation_loss}")
    for file in sorted(stored.glob("*.safetensors")):
        tensors, _ = load_tensors(file)
        if wrong := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
            raise DivergedError(f"the model is not finite in {', '.join(wrong)}")
