"""Supervised models, fitted before any policy: behaviour policies, dynamics, an action autoencoder.

In: a dataset. Out: a fitted model, stored as a folder. Each model has a file or folder here and a
record in ``MODELS``, by which plans and tasks use it; `transition/` makes virtual trajectories.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from components.data.sizes import DataSizes, relative_weights
from components.models import action_vae, behaviour_policy
from components.models.gaussian_behaviour import (
    GaussianBehaviour,
    GaussianBehaviourConfig,
    fit_gaussian_behaviour,
)
from components.models.mlp_ensemble.config import (
    DeterministicEnsembleConfig,
    GaussianEnsembleConfig,
    MLPEnsembleConfig,
    ResidualEnsembleConfig,
)
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from components.models.mlp_ensemble.fit import fit_mlp_ensemble
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble, RecurrentEnsembleConfig
from components.models.recurrent_ensemble.fit import fit_recurrent_ensemble
from components.models.supervised import Fit
from components.policies.policy import Policy

__all__ = ["MODELS", "ModelKind"]


C = TypeVar("C")


@dataclass(frozen=True)
class ModelKind(Generic[C]):
    """One kind of supervised model.

    Attributes:
        config: Its configuration, a frozen dataclass.
        fit: ``fit(dataset, config, key, device, checkpoint, monitor)``: trains on all but the last
            trajectories, resumably.
        load: Reads the folder that the fitted model's ``save`` filled.
        cost: Core-seconds of a fit with given settings to data of given sizes, measured roughly on
            a computer of 2026.
        version: Of its code, part of node keys; to be raised when a change can change its fits.
    """

    config: type[C]
    fit: Callable[..., Fit[Any]]
    load: Callable[[Path], Any]
    cost: Callable[[C, DataSizes], float]
    version: int


def _per_epoch(seconds: float) -> Callable[[Any, DataSizes], float]:
    """The cost of fits in epochs, from core-seconds for one of 100,000 transitions.

    They hold for the default network on the Industrial Benchmark.
    """
    return lambda config, sizes: (
        seconds * config.epochs * sizes.transitions / 1e5 * relative_weights(config, sizes)
    )


def _recurrent_cost(config: RecurrentEnsembleConfig, sizes: DataSizes) -> float:
    steps = config.warm_up + config.horizon
    networks = config.members * (2 if config.networks == "separate" else 1)
    return 3.4e-7 * config.updates * config.batch * networks * steps * config.hidden / 30


def _mlp_cost(config: MLPEnsembleConfig, sizes: DataSizes) -> float:
    observed = (config.history or sizes.history) * sizes.frame
    widths = (observed + sizes.action, *config.hidden, sizes.frame)
    weights = sum(inputs * outputs for inputs, outputs in pairwise(widths))
    passes = config.epochs * sizes.transitions / 1e5
    return 6.5e-6 * passes * config.members * len(config.forms) * weights


MODELS: Final[Mapping[str, ModelKind[Any]]] = MappingProxyType(
    {
        "behaviour_policy": ModelKind(
            behaviour_policy.BehaviourPolicyConfig,
            behaviour_policy.fit_behaviour_policy,
            Policy.load,
            _per_epoch(0.2),
            version=7,
        ),
        "gaussian_behaviour": ModelKind(
            GaussianBehaviourConfig,
            fit_gaussian_behaviour,
            GaussianBehaviour.load,
            _per_epoch(0.5),
            version=7,
        ),
        "recurrent_ensemble": ModelKind(
            RecurrentEnsembleConfig,
            fit_recurrent_ensemble,
            RecurrentEnsemble.load,
            _recurrent_cost,
            version=6,
        ),
        "deterministic_ensemble": ModelKind(
            DeterministicEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load, _mlp_cost, version=6
        ),
        "gaussian_ensemble": ModelKind(
            GaussianEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load, _mlp_cost, version=6
        ),
        "residual_ensemble": ModelKind(
            ResidualEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load, _mlp_cost, version=6
        ),
        "action_vae": ModelKind(
            action_vae.ActionVAEConfig,
            action_vae.fit_action_vae,
            action_vae.ActionVAE.load,
            _per_epoch(7.5),
            version=6,
        ),
    }
)
