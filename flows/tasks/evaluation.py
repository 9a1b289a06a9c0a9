"""Evaluation in the real environment as a task function; the seeds of a pair arrive together."""

from collections.abc import Sequence

import numpy as np
import torch

from components.core.random_streams import lane_key
from components.environments.systems import check_simulator
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import evaluate_policies
from components.policies.policy import Policy
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import inherit_datasets, percent, read_input, write_curves

__all__ = ["evaluate"]


def evaluate(jobs: Sequence[Job], context: TaskContext) -> None:
    """Real-environment evaluation: `returns.npz` holds every snapshot's returns."""
    first = jobs[0].config
    check_simulator(first["environment"], first.get("simulator", ""))
    protocol, discount = EvaluationProtocol.of_record(first["evaluation"])
    policies = [read_input(job, "policy", Policy.load, "policy") for job in jobs]
    results = evaluate_policies(
        policies,
        [read_input(job, "behaviour_policy", Policy.load, "model") for job in jobs],
        first["environment"],
        first["parameters"],
        protocol,
        discount,
        [lane_key("evaluation", *job.config["stream"]) for job in jobs],
        torch.device(context.device),
        context.progress,
        context.threads,
    )
    for job, policy, result in zip(jobs, policies, results, strict=True):
        with (job.out / "returns.npz").open("wb") as file:
            np.savez(
                file,
                lambdas=result.proximities,  # the name in stored files
                returns=result.returns,
                distances=result.distances,
                steps=np.asarray(policy.card.steps),
                ended_at=np.asarray([] if policy.card.ended_at is None else [policy.card.ended_at]),
            )
        means = result.returns.mean(axis=-1)  # [S, proximities]
        curves = {}
        for column, value in enumerate(result.proximities):
            if np.isnan(value):
                curves["evaluation/return"] = (policy.card.steps, means[:, column])
                curves["evaluation/distance"] = (policy.card.steps, result.distances[:, column])
            elif round(100 * value) % 25 == 0:
                name = f"evaluation/return_at_proximity_{value:.2f}"
                curves[name] = (policy.card.steps, means[:, column])
        if policy.card.takes_proximity:
            steps = percent(result.proximities)
            curves["over_proximity/return"] = (steps, means[-1])
            curves["over_proximity/distance"] = (steps, result.distances[-1])
        write_curves(job.out / "curves.npz", curves)
        inherit_datasets(job, "policy")
