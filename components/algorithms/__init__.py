"""The learners: one module for each method, all with the same outline; what they share in parts/.

In: the logged transitions of lanes, with fitted models where a method needs them. Out: policies,
which are never evaluated on the real system here. A module holds settings (``Config``) and the
stack of learners (``Learner``) and ends with the record (``ALGORITHM``) by which plans and tasks
use the method, see :class:`components.algorithms.parts.algorithm.Algorithm`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

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
from components.algorithms.parts.algorithm import Algorithm

__all__ = ["ALGORITHMS"]

_RECORDS: tuple[Algorithm[Any], ...] = (
    bc.ALGORITHM,
    ddpg.ALGORITHM,
    bcq.ALGORITHM,
    bear.ALGORITHM,
    brac.ALGORITHM,
    cql.ALGORITHM,
    td3_bc.ALGORITHM,
    lion.ALGORITHM,
    model_based.ALGORITHM,
    wsbc.ALGORITHM,
    moose.ALGORITHM,
    lambda_td3_bc.ALGORITHM,
    rvs.ALGORITHM,
    mopo.ALGORITHM,
    morel.ALGORITHM,
)

ALGORITHMS: Final[Mapping[str, Algorithm[Any]]] = MappingProxyType(
    {record.name: record for record in _RECORDS}
)
"""By name, in the order in which tables and plans show them."""
