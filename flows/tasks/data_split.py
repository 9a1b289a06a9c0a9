"""The split of a log as a task function: what policies learn from, and what judges them."""

from collections.abc import Sequence

from components.data.assembly import divided
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import note_dataset, open_dataset

__all__ = ["split_log"]


def split_log(jobs: Sequence[Job], context: TaskContext) -> None:
    """Split of a log: `dataset/` holds its first episodes (`train`), or its last ones (`judge`)."""
    for job in jobs:
        parts = divided(open_dataset(job), job.config["held_out"])
        part = dict(zip(("train", "judge"), parts, strict=True))[job.config["part"]]
        part.write(job.out / "dataset")
        note_dataset(job, part)
