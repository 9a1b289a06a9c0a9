"""The tasks of the benchmark with a checkpoint every fifth of a second, for workers."""

from collections.abc import Sequence
from typing import Any

from components.training.loop import TrainingLoop
from flows.pipeline.task import Job, TaskContext
from flows.tasks import model_fitting, policy_training

__all__ = ["fit_model", "train"]

_begin = TrainingLoop.__init__


def _saving_often(self: TrainingLoop, *args: Any, **kwargs: Any) -> None:
    _begin(self, *args, **kwargs)
    self.save_every = 0.2


TrainingLoop.__init__ = _saving_often  # type: ignore[method-assign]


def train(jobs: Sequence[Job], context: TaskContext) -> None:
    """Policy training."""
    policy_training.train(jobs, context)


def fit_model(jobs: Sequence[Job], context: TaskContext) -> None:
    """Model fitting."""
    model_fitting.fit_model(jobs, context)
