"""Measurement of a log's indicators as a task function."""

from collections.abc import Sequence
from dataclasses import asdict

import torch

from components.core.random_streams import lane_key
from components.data.indicators import log_facts
from components.models.action_stochasticity import StochasticityConfig, fit_action_stochasticity
from components.models.supervised import Monitor
from components.training.divergence import DivergedError, diverged
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import config_object, note_dataset, open_dataset, write_numbers

__all__ = ["INDICATORS", "measure_indicators"]

INDICATORS = "indicators.json"
"""File of an artifact: what a log shows, and the spread of its actions."""


def measure_indicators(jobs: Sequence[Job], context: TaskContext) -> None:
    """Measurement of indicators: `indicators.json` holds `facts` and `stochasticity` of a log."""
    for job in jobs:
        dataset = open_dataset(job)
        config = config_object(StochasticityConfig, job.config["stochasticity"])
        try:
            facts = log_facts(dataset)
            found = fit_action_stochasticity(
                dataset,
                config,
                lane_key(dataset.card.name, "action_stochasticity"),
                torch.device(context.device),
                context.work / f"{job.key}.safetensors",
                Monitor(context.progress, context.validated),
            )
        except DivergedError as error:
            section, settings = "ranking.stochasticity", job.config["stochasticity"]
            what = f"The fit of the action spread of {dataset.card.name}"
            job.fail(diverged(what, error, section, settings))
            continue
        except ValueError as error:
            job.fail(f"{dataset.card.name} cannot be ranked: {error}")
            continue
        write_numbers(
            job.out / INDICATORS, {"facts": asdict(facts), "stochasticity": asdict(found)}
        )
        write_numbers(
            job.out / "metrics.json",
            {
                "indicator/eas": found.eas,
                "return/first_window_mean": facts.return_mean,
                "return/first_window_max": facts.return_max,
            },
        )
        note_dataset(job, dataset)
