"""Model fitting as a task function.

Hyperparameter search runs this module in its workers. It therefore imports no environment, no
evaluation and no algorithm, and neither does anything it imports: an import contract and a test
hold it to that.
"""

from collections.abc import Sequence

import torch

from components.core.random_streams import lane_key
from components.models import MODELS
from components.models.supervised import Monitor
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    note_dataset,
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
