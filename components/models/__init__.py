"""What is learned supervised, by name: each model's configuration, its fit and its artifact."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from components.models import behaviour_policy, recurrent_fit
from components.models.recurrent_ensemble import RecurrentEnsemble, RecurrentEnsembleConfig
from components.models.supervised import Fit
from components.networks.policy import Policy

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
        "recurrent_ensemble": ModelKind(
            RecurrentEnsembleConfig,
            recurrent_fit.fit_recurrent_ensemble,
            RecurrentEnsemble.load,
        ),
    }
)
