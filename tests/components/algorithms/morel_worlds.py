"""Learners on hand-made models, on which MOReL is tested."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from components.algorithms import morel
from components.algorithms.parts.learner import LearnerInputs
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from tests.components.algorithms.plain import floats
from tests.components.algorithms.stacks import config, learner
from tests.components.synthetic import CPU, FEATURES, make_log, random_model

LOG = make_log()
STEPS, MEMBERS, HORIZON = 40, 3, 5
HALT_RETURN = (float(LOG.rewards.min()) - 1.0) / 0.03


def history_of(row: int) -> np.ndarray:
    """Raw frames ``[H, F]`` of a transition, newest first, gathered one by one."""
    episode, step = divmod(row, STEPS)
    first = episode * (STEPS + 1)
    return np.stack([LOG.frames[first + max(step - lag, 0)] for lag in range(3)])


def means(made: Any, lane: int, seen: np.ndarray) -> np.ndarray:
    """The policy's mean actions, tanh between its layers."""
    layers = [(floats(w)[lane], floats(b)[lane, 0]) for w, b in made._actor.stack.affine()]
    for weight, bias in layers[:-1]:
        seen = np.tanh(seen @ weight + bias)
    return seen @ layers[-1][0] + layers[-1][1]


def scaled(history: np.ndarray) -> np.ndarray:
    mean, scale = (
        LOG.frames.mean(axis=0, dtype=np.float64),
        LOG.frames.std(axis=0, dtype=np.float64),
    )
    scale[0] = 1.0
    return ((history - mean) / scale).ravel()


def prepared(*seeds: int, **changes: Any) -> Any:
    """Learners whose pretraining is over and whose mean actions reach beyond the box."""
    made = learner("morel", [LOG] * len(seeds), seeds, cloning=0, **changes)
    with torch.no_grad():
        for parameter in made._actor.stack.affine()[-1]:
            parameter.mul_(400.0)
    return made


def rolled_out(made: Any, step: int = 0) -> tuple[dict[str, torch.Tensor], Any]:
    drawn = {k: v.clone() for k, v in made._streams.at(step).items()}
    return drawn, made._roll_out(made._starts(drawn), drawn["noise"])


def linear_ensemble(
    log: OfflineDataset, consumption: Sequence[float], disagree_below: float, members: int = 2
) -> MLPEnsemble:
    """Members that predict the consumption ``a + b * shift``, in normalised units.

    The last one takes off twice what the shift is below a limit, in normalised units: too good to
    be true.
    """
    base = random_model("residual_ensemble", log)
    inputs = 3 * len(FEATURES) + 4
    first, last = torch.zeros(members, inputs, 2), torch.zeros(members, 2, 2)
    bias = torch.zeros(members, 1, 2)
    first[:, -1, 0], bias[:, 0, 0] = 1.0, 9.0  # always active: shifts lie above -9
    first[:, -1, 1], bias[:, 0, 1] = -1.0, disagree_below
    offset, slope = consumption
    last[:, 0, 1] = slope
    last[-1, 1, 1] = -2.0
    last_bias = torch.zeros(members, 1, 2)
    last_bias[:, 0, 1] = offset - 9.0 * slope
    return dataclasses.replace(
        base,
        layers=((first, bias), (last, last_bias)),
        low=torch.full((2,), -50.0),
        high=torch.full((2,), 50.0),
        target="value",
        target_mean=torch.zeros(2),
        target_scale=torch.ones(2),
        elites=tuple(range(members)),
    )


def in_world(ensemble: MLPEnsemble, **changes: Any) -> Any:
    inputs = LearnerInputs(
        LaneData([LOG], CPU),
        [lane_key("world", 0)],
        {"residual_ensemble": [ensemble]},
    )
    more = {
        "trajectories": 50,
        "horizon": 8,
        "iterations": 10,
        "fisher_samples": 400,
        "value_hidden": (32,),
        "learning_rate": 1e-2,
        "batch": 64,
    }
    return morel.Learner(config("morel", cloning=0, **(more | changes)), inputs)
