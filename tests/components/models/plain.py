"""One-step ensembles in double precision, member by member and row by row."""

from collections.abc import Callable

import numpy as np
import torch

from components.models.mlp_ensemble.ensemble import MLPEnsemble
from tests.components.synthetic import SCALE


def doubles(tensor: torch.Tensor) -> np.ndarray:
    """The numbers of a tensor."""
    return tensor.detach().double().numpy()


def member_outputs(
    ensemble: MLPEnsemble, member: int, history: np.ndarray, inputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A member's normalised targets ``[2]`` and their deviations ``[2]`` in the same unit.

    Args:
        ensemble: Any kind; deterministic members deviate by 0.
        member: Number.
        history: ``[H, F]`` raw frames, newest first, at least as many as the ensemble reads.
        inputs: ``[4]`` raw inputs of the next frame.
    """
    mean, scale = doubles(ensemble.frames.mean), doubles(ensemble.frames.scale)
    seen = (history[: ensemble.history].astype(np.float64) - mean) / scale
    x = np.concatenate([seen.ravel(), (inputs - mean[:4]) / scale[:4]])
    for number, (weight, bias) in enumerate(ensemble.layers):
        if number:
            x = np.maximum(x, 0.0) if ensemble.activation == "relu" else x / (1.0 + np.exp(-x))
        x = x @ doubles(weight[member]) + doubles(bias[member, 0])
    unit = doubles(ensemble.target_scale)
    values = x[:2] * unit + doubles(ensemble.target_mean)
    if ensemble.target == "change":
        values = values + seen[0, 4:]
    if not ensemble.log_variance.numel():
        return values, np.zeros(2)
    low, high = doubles(ensemble.log_variance[member])
    below = high - np.log1p(np.exp(high - x[2:]))
    log_variance = low + np.log1p(np.exp(below - low))
    return values, np.sqrt(np.exp(log_variance)) * unit


def trajectory(
    ensemble: MLPEnsemble,
    history: np.ndarray,
    actions: np.ndarray,
    choose: Callable[[int, np.ndarray], int],
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Rewards ``[T]`` and next frames ``[T, F]`` of one virtual trajectory.

    Args:
        ensemble: Any kind.
        history: ``[H, F]`` raw frames, newest first.
        actions: ``[T, 3]``.
        choose: Step and the members' rewards, their predictions clipped, to the member followed.
        noise: ``[T, 2]`` in units of the member's deviation.
    """
    mean, scale = doubles(ensemble.frames.mean)[4:], doubles(ensemble.frames.scale)[4:]
    low, high = doubles(ensemble.low), doubles(ensemble.high)
    history = history.astype(np.float64)
    rewards, frames = [], []
    for step, action in enumerate(actions):
        steering = np.clip(history[0, 1:4] + SCALE * action, 0.0, 100.0)
        inputs = np.concatenate([history[0, :1], steering])
        said = [member_outputs(ensemble, k, history, inputs) for k in range(ensemble.members)]

        def raw(values: np.ndarray) -> np.ndarray:
            return np.clip(values, low, high) * scale + mean

        of_members = np.array([np.array([-0.03, -0.01]) @ raw(values) for values, _ in said])
        values, deviation = said[choose(step, of_members)]
        outputs = raw(values + deviation * noise[step])
        frame = np.concatenate([inputs, outputs])
        rewards.append(np.array([-0.03, -0.01]) @ outputs)
        frames.append(frame)
        history = np.concatenate([frame[None], history[:-1]])
    return np.array(rewards), np.array(frames)
