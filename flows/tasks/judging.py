"""Judgement of policies from a log as a task function; the policies of a log arrive together."""

from collections.abc import Sequence

import numpy as np
import torch

from components.data.dataset import OfflineDataset
from components.judging.config import JudgeConfig
from components.judging.judged import JudgedPolicies
from components.judging.judgement import Judgement, judge
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.policies.policy import Policy
from components.training.memory import keep_freed_memory
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    inherit_datasets,
    open_dataset,
    percent,
    read_input,
    write_curves,
    write_numbers,
)

__all__ = ["JUDGEMENT", "judge_policies"]

JUDGEMENT = "judgement.npz"
"""File of an artifact: every estimate `[snapshots, proximities]`, that of the behaviour policy in
`behaviour/...`, `steps` and `proximities`.

Judgements of before lack the ends of the `frames` in the ensemble and the share `held` at its ends,
`[snapshots, proximities, 2, F]`, the behaviour policy's `held_usually` and the ends of the log's
part, `logged_frames`, `[2, F]`.
"""


def judge_policies(jobs: Sequence[Job], context: TaskContext) -> None:
    """Judgement from a log: `judgement.npz` holds all estimates of a run's last snapshots."""
    keep_freed_memory()
    first = jobs[0]
    config = config_object(JudgeConfig, first.config["estimates"])
    behaviour = read_input(first, "behaviour_policy", Policy.load, "model")
    reference = JudgedPolicies.of(behaviour, ())
    judged = [_judged(job, config) for job in jobs]
    own = [_ensemble(job, "trained_in") for job in jobs]
    dataset = open_dataset(first)
    usual, *found = judge(
        dataset,
        _ensemble(first, "recurrent_ensemble"),
        behaviour,
        [reference, *judged],
        [None, *own],
        config,
        torch.device(context.device),
        names=["behaviour", *(job.key for job in jobs)],
        checkpoint=context.work / "fitted_q.safetensors",
        progress=context.progress,
    )
    for job, one, judgement in zip(jobs, judged, found, strict=True):
        _write(job, one, judgement, usual, dataset)


def _ensemble(job: Job, role: str) -> RecurrentEnsemble | None:
    """The ensemble of a role, if the job has one."""
    if role not in job.inputs:
        return None
    return read_input(job, role, RecurrentEnsemble.load, "model")


def _judged(job: Job, config: JudgeConfig) -> JudgedPolicies:
    policy = read_input(job, "policy", Policy.load, "policy")
    last = slice(max(0, policy.lanes - job.config["snapshots"]), policy.lanes)
    return JudgedPolicies.of(policy.select(last, policy.card), config.proximities)


def _write(
    job: Job,
    judged: JudgedPolicies,
    judgement: Judgement,
    usual: Judgement,
    dataset: OfflineDataset,
) -> None:
    shape = judged.policy.lanes, len(judged.proximities)
    estimates = {name: values.reshape(shape) for name, values in judgement.estimates.items()}
    with (job.out / JUDGEMENT).open("wb") as file:
        np.savez(
            file,
            steps=np.asarray(judged.policy.card.steps[-shape[0] :]),
            proximities=np.asarray(judged.proximities),
            **estimates,
            frames=judgement.frames.reshape(*shape, *judgement.frames.shape[1:]),
            held=judgement.held.reshape(*shape, *judgement.held.shape[1:]),
            held_usually=usual.held[0],
            logged_frames=np.stack([dataset.frames.min(axis=0), dataset.frames.max(axis=0)]),
            **{f"behaviour/{name}": values for name, values in usual.estimates.items()},
        )
    last = {name: values[-1] for name, values in estimates.items()}
    if judged.policy.card.takes_proximity:
        steps = percent(np.asarray(judged.proximities))
        curves = {f"over_proximity/judged_{n}": (steps, v.tolist()) for n, v in last.items()}
        write_curves(job.out / "curves.npz", curves)
    else:
        numbers = {f"judged/{name}": float(values[0]) for name, values in last.items()}
        write_numbers(
            job.out / "metrics.json", {n: v for n, v in numbers.items() if np.isfinite(v)}
        )
    inherit_datasets(job, "policy")
