"""Policy training as a task function.

The seeds of one (dataset, algorithm) pair arrive together and are lanes of one program; what a lane
computes does not depend on the others.
"""

from collections.abc import Sequence

import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.training import learner_inputs, train_policies
from components.models import MODELS
from components.policies.policy import Policy
from components.training.divergence import DivergedError, diverged
from components.training.loop import Curves
from components.training.memory import keep_freed_memory
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    note_dataset,
    noting_lost_graphs,
    open_dataset,
    read_input,
    write_curves,
    write_numbers,
)

__all__ = ["train"]


def train(jobs: Sequence[Job], context: TaskContext) -> None:
    """Policy training: `policy/` holds the snapshots of a run; one lane per job."""
    keep_freed_memory()
    algorithm = ALGORITHMS[jobs[0].config["algorithm"]]
    config = config_object(algorithm.config, jobs[0].config["settings"])
    datasets = [open_dataset(job) for job in jobs]
    inputs = learner_inputs(
        algorithm,
        datasets,
        [job.config["seed"] for job in jobs],
        {
            name: [read_input(job, name, MODELS[name].load, "model") for job in jobs]
            for name in algorithm.models_for(config)
        },
        torch.device(context.device),
    )
    policies: Sequence[Policy | DivergedError]
    try:
        with noting_lost_graphs(jobs):
            policies, curves = train_policies(
                algorithm,
                algorithm.learner(config, inputs),
                datasets,
                [job.key for job in jobs],
                updates=config.updates,
                snapshots=jobs[0].config["snapshots"],
                work=context.work,
                progress=context.progress,
                device=torch.device(context.device),
            )
    except DivergedError as error:
        policies, curves = [error] * len(jobs), Curves()
    for lane, (job, policy) in enumerate(zip(jobs, policies, strict=True)):
        if isinstance(policy, DivergedError):
            section, settings = f"algorithm.{algorithm.name}", job.config["settings"]
            job.fail(diverged(f"The training of {job.name}", policy, section, settings))
            continue
        (job.out / "policy").mkdir()
        policy.save(job.out / "policy")
        write_curves(job.out / "curves.npz", curves.of_lane(lane))
        if policy.card.ended_at is not None:
            write_numbers(job.out / "metrics.json", {"training/ended_at": policy.card.ended_at})
        note_dataset(job, datasets[lane])
