"""Worlds with known Gaussian models, in which MOPO is tested."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from components.algorithms import mopo
from components.algorithms.parts.learner import LearnerInputs
from components.core.normaliser import Normaliser
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from tests.components.algorithms.plain import floats
from tests.components.algorithms.stacks import config
from tests.components.synthetic import (
    keys,
    make_log,
    next_outputs,
)

LOG = make_log()
OTHER = make_log("other", seed=5, explore=0.2)
HISTORY, STEPS = 3, 40
EVERY, COUNT, LENGTH, KEPT = 6, 20, 4, 3  # of the small learners
NETWORKS = ("actor", "critics", "critics_target", "log_temperature")


def ensemble(
    weight: np.ndarray, bias: np.ndarray, elites: Sequence[int], target: str, log: OfflineDataset
) -> MLPEnsemble:
    """Members without hidden layers; bounds of log variances so wide that they change nothing."""
    members = len(bias)
    return MLPEnsemble(
        layers=((torch.from_numpy(weight).float(), torch.from_numpy(bias).float()[:, None]),),
        frames=Normaliser.fit(log.frames),
        observed=(0, 6),
        low=torch.full((2,), -50.0),
        high=torch.full((2,), 50.0),
        target_mean=torch.zeros(2),
        target_scale=torch.ones(2),
        log_variance=torch.tensor([[-60.0], [60.0]]).expand(members, 2, 2).clone(),
        history=HISTORY,
        activation="swish",
        target=target,
        elites=tuple(elites),
    )


def constant(
    changes: Sequence[Sequence[float]], deviations: Sequence[Sequence[float]], elites: Sequence[int]
) -> MLPEnsemble:
    """Members that predict the same changes and deviations everywhere, ``[K, D]`` each."""
    bias = np.concatenate([changes, 2.0 * np.log(deviations)], axis=1)
    weight = np.zeros((len(bias), HISTORY * 6 + 4, 4))
    return ensemble(weight, bias, elites, "change", LOG)


def true_ensemble(
    log: OfflineDataset,
    log_variance: Sequence[float],
    slope: Sequence[float],
    elites: Sequence[int],
) -> MLPEnsemble:
    """Members that know the small machine, which is linear.

    Args:
        log: Whose scaling to use.
        log_variance: ``[K]`` of both targets at the mean gain.
        slope: ``[K]`` of it in the next frame's standardised gain.
        elites: Members that are followed.
    """
    scaling = Normaliser.fit(log.frames)
    mean, scale = floats(scaling.mean), floats(scaling.scale)
    first = HISTORY * 6  # where the next frame's inputs begin
    weight = np.zeros((len(slope), first + 4, 4))
    bias = np.zeros((len(slope), 4))
    for member in range(len(slope)):
        at_zero = next_outputs(mean[None, 1:4], mean[4:5])[0]
        bias[member] = [*((at_zero - mean[4:]) / scale[4:]), *[log_variance[member]] * 2]
        for row, feature in ((first + 1, 1), (first + 2, 2), (first + 3, 3), (4, 4)):
            moved = mean.copy()
            moved[feature] += scale[feature]
            change = next_outputs(moved[None, 1:4], moved[4:5])[0] - at_zero
            weight[member, row, :2] = change / scale[4:]
        weight[member, first + 2, 2:] = slope[member]
    return ensemble(weight, bias, elites, "value", log)


def made_of(
    ensembles: Sequence[MLPEnsemble], log: OfflineDataset = LOG, **changes: Any
) -> mopo.Learner:
    """One lane for each ensemble."""
    lanes = len(ensembles)
    data = LaneData([log] * lanes, torch.device("cpu"), mopo.ALGORITHM.frame_epsilon)
    models = {"gaussian_ensemble": list(ensembles)}
    return mopo.Learner(config("mopo", **changes), LearnerInputs(data, keys(*range(lanes)), models))


def raw_targets(made: mopo.Learner, scaled: Tensor) -> np.ndarray:
    """Fatigue and consumption ``[L, ..., 2]`` of frames as the policies see them."""
    scaling = made._data.frame_scaling
    mean, scale = (
        floats(s).reshape(made.lanes, *[1] * (scaled.ndim - 2), 6)[..., 4:]
        for s in (scaling.mean, scaling.scale)
    )
    return floats(scaled)[..., 4:] * scale + mean
