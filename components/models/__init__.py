"""What is learned supervised, by name: each model's configuration, its fit and its artifact."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from components.models import action_vae, behaviour_policy
from components.models.gaussian_behaviour import (
    GaussianBehaviour,
    GaussianBehaviourConfig,
    fit_gaussian_behaviour,
)
from components.models.mlp_ensemble.config import (
    DeterministicEnsembleConfig,
    GaussianEnsembleConfig,
    ResidualEnsembleConfig,
)
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from components.models.mlp_ensemble.fit import fit_mlp_ensemble
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble, RecurrentEnsembleConfig
from components.models.recurrent_ensemble.fit import fit_recurrent_ensemble
from components.models.supervised import Fit
from components.policies.policy import Policy

__all__ = ["MODELS", "ModelKind"]


@dataclass(frozen=True)
class ModelKind:
    """One kind of supervised model.

    Attributes:
        config: Its configuration, a frozen dataclass.
        fit: ``fit(dataset, config, key, device, checkpoint, monitor)``: trains on all but the last
            trajectories, resumably.
        load: Reads the folder that the fitted model's ``save`` filled.
    """

    config: type
    fit: Callable[..., Fit[Any]]
    load: Callable[[Path], Any]


MODELS: Final[Mapping[str, ModelKind]] = MappingProxyType(
    {
        "behaviour_policy": ModelKind(
            behaviour_policy.BehaviourPolicyConfig,
            behaviour_policy.fit_behaviour_policy,
            Policy.load,
        ),
        "gaussian_behaviour": ModelKind(
            GaussianBehaviourConfig, fit_gaussian_behaviour, GaussianBehaviour.load
        ),
        "recurrent_ensemble": ModelKind(
            RecurrentEnsembleConfig,
            fit_recurrent_ensemble,
            RecurrentEnsemble.load,
        ),
        "deterministic_ensemble": ModelKind(
            DeterministicEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load
        ),
        "gaussian_ensemble": ModelKind(GaussianEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load),
        "residual_ensemble": ModelKind(ResidualEnsembleConfig, fit_mlp_ensemble, MLPEnsemble.load),
        "action_vae": ModelKind(
            action_vae.ActionVAEConfig, action_vae.fit_action_vae, action_vae.ActionVAE.load
        ),
    }
)
