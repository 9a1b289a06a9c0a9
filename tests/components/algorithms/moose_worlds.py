"""Learners with hand-made models and plain loops over them, on which MOOSE is tested."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from components.algorithms import moose
from components.algorithms.moose import Config, Learner
from components.algorithms.parts.learner import LearnerInputs
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from tests.components.algorithms.plain import floats, network
from tests.components.algorithms.stacks import SMALL
from tests.components.models.test_action_vae import rebuilt
from tests.components.synthetic import (
    CPU,
    SCALE,
    make_log,
    random_model,
)

LOG = make_log()
OTHER = make_log("other", seed=5, explore=0.2)
HISTORY, STEPS, MEMBERS = 3, 40, 3


def moose_learner(
    logs: Sequence[OfflineDataset] = (LOG,),
    seeds: Sequence[int] = (0,),
    models: dict[str, Any] | None = None,
    **changes: Any,
) -> Learner:
    """A small stack; its models are the given ones, for all lanes, or random ones of each log."""
    found = {name: [random_model(name, log) for log in logs] for name in moose.ALGORITHM.needs}
    found |= {name: [model] * len(logs) for name, model in (models or {}).items()}
    keys = [lane_key(log.card.name, "moose", seed) for log, seed in zip(logs, seeds, strict=True)]
    settings = Config(**(SMALL["moose"] | changes))
    return Learner(settings, LearnerInputs(LaneData(logs, CPU), keys, found))


def exact_ensemble(*extra: float) -> MLPEnsemble:
    """The small machine itself; member k consumes ``extra[k]`` more."""
    scaling = Normaliser.fit(LOG.frames)
    mean, scale = floats(scaling.mean), floats(scaling.scale)
    raw = np.zeros((HISTORY * 6 + 4, 2))  # what raw inputs contribute to raw outputs
    raw[[4, 19, 21], 0] = 0.6, 0.2, 0.1
    raw[[19, 20, 21], 1] = 0.8, 0.5, -0.3
    means = np.concatenate([np.tile(mean, HISTORY), mean[:4]])
    scales = np.concatenate([np.tile(scale, HISTORY), scale[:4]])
    biases = [(means @ raw + (0.0, 20.0 + more) - mean[4:]) / scale[4:] for more in extra]
    weight = torch.from_numpy(scales[:, None] * raw / scale[4:]).float()
    return MLPEnsemble(
        layers=(
            (weight.repeat(len(extra), 1, 1), torch.from_numpy(np.array(biases)).float()[:, None]),
        ),
        frames=scaling,
        observed=(0, 6),
        low=torch.full((2,), -99.0),
        high=torch.full((2,), 99.0),
        target_mean=torch.zeros(2),
        target_scale=torch.ones(2),
        log_variance=torch.empty(0),
        history=HISTORY,
        activation="relu",
        target="value",
        elites=tuple(range(len(extra))),
    )


def history_of(log: OfflineDataset, row: int) -> np.ndarray:
    """Raw frames ``[H, F]`` of a transition, newest first, gathered one by one."""
    episode, step = divmod(row, STEPS)
    first = episode * (STEPS + 1)
    frames = [log.frames[first + max(step - lag, 0)] for lag in range(HISTORY)]
    return np.stack(frames).astype(np.float64)


def predicted(ensemble: MLPEnsemble, k: int, history: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Raw fatigue and consumption that member k predicts."""
    mean, scale = floats(ensemble.frames.mean), floats(ensemble.frames.scale)
    scaled = (history - mean) / scale
    x = np.append(scaled.flatten(), (inputs - mean[:4]) / scale[:4])
    for number, (weight, bias) in enumerate(ensemble.layers):
        x = (np.maximum(x, 0.0) if number else x) @ floats(weight)[k] + floats(bias)[k, 0]
    out = x * floats(ensemble.target_scale) + floats(ensemble.target_mean)
    if ensemble.target == "change":
        out = out + scaled[0, 4:]
    return np.clip(out, floats(ensemble.low), floats(ensemble.high)) * scale[4:] + mean[4:]


def trajectory(
    made: Learner, lane: int, log: OfflineDataset, k: int, row: int, latent: np.ndarray
) -> tuple[float, float]:
    """Discounted return and penalty of one member's trajectory, in double precision."""
    mean = log.frames.mean(axis=0, dtype=np.float64)
    scale = log.frames.std(axis=0, dtype=np.float64)
    scale[0] = 1.0
    ensemble, autoencoder = (
        random_model(name, log) for name in ("deterministic_ensemble", "action_vae")
    )
    history, total, penalty = history_of(log, row), 0.0, 0.0
    for t in range(len(latent)):
        seen = ((history - mean) / scale).flatten()[None]
        action = np.tanh(network(made._actor, lane, seen)[0])
        *_, again = rebuilt(autoencoder, history, action, latent[t])
        penalty += made._config.penalty_discount**t * np.square(action - again).mean()
        steering = np.clip(history[0, 1:4] + SCALE * action, 0.0, 100.0)
        inputs = np.append(history[0, :1], steering)
        outputs = predicted(ensemble, k, history, inputs)
        total += 0.97**t * (-0.03 * outputs[0] - 0.01 * outputs[1])
        history = np.vstack([np.concatenate([inputs, outputs]), history[:-1]])
    return total, penalty


def drawn_for(made: Learner, step: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Start rows, what is seen and known in them, and the latents' noise of an update."""
    drawn = {name: value.clone() for name, value in made._streams.at(step).items()}
    start = drawn["start"]
    return start, *made._data.start_states(start, 1), drawn["latent"]


def gradient(made: Learner, step: int = 0) -> list[Tensor]:
    """Of the loss of an update, for every parameter of the stack of one part."""
    _, *given = drawn_for(made, step)
    [part] = made._parts
    loss, _ = made._loss(part, *given)
    return list(torch.autograd.grad(loss.sum(), list(part.actor.parameters())))
