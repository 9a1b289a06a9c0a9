"""Small learners of every algorithm on the small machine."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs
from components.core.random_streams import lane_key
from components.data.batches import Batch, LaneData
from components.data.dataset import OfflineDataset
from tests.components.synthetic import CPU, make_log, random_model, relabelled

PLAIN: dict[str, Any] = {"hidden": (8,), "batch": 16, "learning_rate": 1e-3}
SMALL: dict[str, dict[str, Any]] = {  # the others are small with PLAIN
    "bcq": {
        "hidden": (8,),
        "vae_hidden": (8,),
        "batch": 16,
        "target_actions": 3,
        "deployed_actions": 4,
    },
    "bear": {
        "hidden": (8,),
        "vae_hidden": (8,),
        "batch": 16,
        "updates": 200,
        "actor_learning_rate": 1e-3,
        "learning_rate": 1e-3,
        "target_actions": 3,
        "deployed_actions": 4,
    },
    "brac": {
        "hidden": (8,),
        "critic_hidden": (8,),
        "batch": 16,
        "updates": 100,
        "cloning": 0.1,
        "actor_learning_rate": 1e-3,
    },
    "cql": {
        "hidden": (8,),
        "batch": 16,
        "updates": 200,
        "tried_actions": 3,
        "actor_learning_rate": 1e-3,
        "learning_rate": 1e-3,
    },
    "rvs": {"hidden": (8,), "batch": 16, "window": 10},
    "lion": {"hidden": (8,), "trajectories": 6, "horizon": 5, "learning_rate": 1e-3},
    "moose": {"hidden": (8,), "trajectories": 4, "horizon": 5, "learning_rate": 1e-2},
    "model_based": {"hidden": (8,), "trajectories": 6, "horizon": 5, "learning_rate": 1e-3},
    "wsbc": {
        "box": 0.3,
        "particles": 9,
        "neighbourhood": 3,
        "velocity_limit": 1.0,  # it finds something better in every few of so few iterations
        "starts": 6,
        "horizon": 5,
    },
    "morel": {
        "hidden": (8,),
        "value_hidden": (8,),
        "batch": 16,
        "cloning": 10,
        "trajectories": 2,
        "horizon": 5,
        "beta": 1.0,
        "iterations": 5,
        "fisher_samples": 20,
    },
    "mopo": {
        "hidden": (8,),
        "batch": 16,
        "learning_rate": 1e-3,
        "rollout_every": 6,
        "rollouts": 20,
        "rollout_length": 4,
        "retained_rollouts": 3,
        "real_ratio": 0.25,
    },
}

# Those whose update takes milliseconds even when small; the quick tests leave them to the others.
HEAVY = ("bcq", "bear", "brac", "cql", "lion", "model_based", "moose", "mopo", "morel", "wsbc")


def graded(names: Iterable[str], seconds: float) -> list[Any]:
    """Names of learners as parameters, of which the heavy ones are slow."""
    slow = pytest.mark.slow(seconds)
    return [pytest.param(name, marks=slow) if name in HEAVY else name for name in names]


def config(algorithm: str, **changes: Any) -> Any:
    """Small settings of an algorithm."""
    return ALGORITHMS[algorithm].config(**(SMALL.get(algorithm, PLAIN) | changes))


def learner(
    algorithm: str,
    logs: Sequence[OfflineDataset],
    seeds: Sequence[int],
    *,
    device: torch.device = CPU,
    **changes: Any,
) -> Any:
    """A stack with one lane per log and seed; models belong to the log, streams to both."""
    record, settings = ALGORITHMS[algorithm], config(algorithm, **changes)
    inputs = LearnerInputs(
        data=LaneData(logs, device, record.frame_epsilon),
        keys=[
            lane_key(log.card.name, algorithm, seed) for log, seed in zip(logs, seeds, strict=True)
        ],
        models={
            name: [random_model(name, log) for log in logs] for name in record.models_for(settings)
        },
    )
    return record.learner(settings, inputs)


def run(made: Any, updates: int, start: int = 0) -> list[dict[str, torch.Tensor]]:
    """Updates in a row; returns their metrics."""
    return [made.update(step) for step in range(start, start + updates)]


def with_a_terminal() -> OfflineDataset:
    """The small machine's log; its second episode ends in a terminal state, the others by time."""
    log = make_log()
    terminated = np.zeros(log.transitions, dtype=np.bool_)
    terminated[int(log.episode_starts[2]) - 1] = True
    return relabelled(log, terminated=terminated, truncated=log.truncated & ~terminated)


def scattered(made: Any, scale: float, *names: str) -> Any:
    """The same learner with some networks, or all, moved at random, so that no two agree."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name in names or made._networks:
            for parameter in made._networks[name].parameters():
                parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return made


def drawn_by(made: Any, step: int = 0) -> tuple[Batch, dict[str, torch.Tensor]]:
    """Transitions and random numbers of an update."""
    drawn = {k: v.clone() for k, v in made._streams.at(step).items()}
    return made._data.batch(drawn["row"]), drawn
