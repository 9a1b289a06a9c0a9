"""Data generation as a task function."""

from collections.abc import Sequence

from components.data.sources.source import generate, source_kind
from components.environments.systems import check_simulator
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import note_dataset, write_numbers

__all__ = ["generate_dataset"]


def generate_dataset(jobs: Sequence[Job], context: TaskContext) -> None:
    """Data generation: `dataset/` holds the arrays and the card."""
    for job in jobs:
        fields = dict(job.config["spec"])
        if "log" in job.inputs:
            fields["log"] = str(job.inputs["log"])
        source = source_kind(fields)(**fields)
        wanted = job.config.get("ingredients", {})
        if dict(source.ingredients) != wanted:
            raise ValueError(
                f"The files of {source.name} have changed meanwhile; give the same command again."
            )
        if source.environment and "log" not in job.inputs:
            check_simulator(source.environment, job.config.get("simulator", ""))
        dataset = generate(source, job.config["seed"], context.threads)
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
