"""What is learned supervised, by name: each model's configuration, checked on held-out data."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from components.models.behaviour_policy import BehaviourPolicyConfig
from components.models.recurrent_ensemble import RecurrentEnsembleConfig

__all__ = ["MODELS"]

MODELS: Final[Mapping[str, type]] = MappingProxyType(
    {
        "behaviour_policy": BehaviourPolicyConfig,
        "recurrent_ensemble": RecurrentEnsembleConfig,
    }
)
