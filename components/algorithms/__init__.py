"""The learners, by name. One module each, all with the same outline.

A module of an algorithm offers ``Config`` (frozen dataclass), ``Learner`` (a stack of lanes),
``NEEDS`` (fitted models by name), ``TAKES_LAMBDA``, ``FRAME_EPSILON`` (added to feature deviations
when frames are scaled) and ``VERSION`` (to be raised whenever a change of its code can change
results). A learner with updates before its budget, such as BRAC's cloning, counts them in a
property ``Config.preparation``.
"""

from collections.abc import Mapping
from types import MappingProxyType, ModuleType
from typing import Final

from components.algorithms import (
    bc,
    bcq,
    bear,
    brac,
    cql,
    ddpg,
    lambda_td3_bc,
    lion,
    model_based,
    moose,
    mopo,
    morel,
    rvs,
    td3_bc,
    wsbc,
)

__all__ = ["ALGORITHMS"]

ALGORITHMS: Final[Mapping[str, ModuleType]] = MappingProxyType(
    {
        "bc": bc,
        "ddpg": ddpg,
        "bcq": bcq,
        "bear": bear,
        "brac": brac,
        "cql": cql,
        "td3_bc": td3_bc,
        "lion": lion,
        "model_based": model_based,
        "wsbc": wsbc,
        "moose": moose,
        "lambda_td3_bc": lambda_td3_bc,
        "rvs": rvs,
        "mopo": mopo,
        "morel": morel,
    }
)
