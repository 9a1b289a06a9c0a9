"""Model fitting as a task function.

Hyperparameter search runs this module in its workers. It therefore imports no environment, no
evaluation and no algorithm, and neither does anything it imports: an import contract and a test
hold it to that.
"""

from collections.abc import Sequence

import torch

from components.core.files import without_undefined
from components.models import MODELS
from components.models.fitting import fit_into
from components.models.supervised import Monitor
from components.training.divergence import DivergedError, diverged
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    note_dataset,
    noting_lost_graphs,
    open_dataset,
    write_curves,
    write_numbers,
)

__all__ = ["fit_model"]


def fit_model(jobs: Sequence[Job], context: TaskContext) -> None:
    """Model fitting: `model/` holds the fitted model of the job's kind."""
    for job in jobs:
        kind = MODELS[job.config["model"]]
        dataset = open_dataset(job)
        try:
            with noting_lost_graphs([job]):
                fit = fit_into(
                    job.out / "model",
                    job.config["model"],
                    dataset,
                    config_object(kind.config, job.config["settings"]),
                    job.config["seed"],
                    device=torch.device(context.device),
                    checkpoint=context.work / f"{job.key}.safetensors",
                    monitor=Monitor(context.progress, context.validated),
                )
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
