"""The split of a log as a task function: what policies learn from, and what judges them."""

from collections.abc import Sequence

from components.data.assembly import part_of
from components.data.splits import split_episodes
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import note_dataset, open_dataset

__all__ = ["split_log"]


def split_log(jobs: Sequence[Job], context: TaskContext) -> None:
    """Split of a log: `dataset/` holds its first episodes (`train`), or its last ones (`judge`)."""
    for job in jobs:
        dataset = open_dataset(job)
        split = split_episodes(dataset, job.config["held_out"])
        episodes = {"train": split.train, "judge": split.held_out}[job.config["part"]]
        part = part_of(dataset, episodes)
        part.write(job.out / "dataset")
        note_dataset(job, part)
