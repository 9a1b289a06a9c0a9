"""Studies: a question of the thesis each, answered from stored runs by ``python -m flows.study``.

A study names what is to be run (words of a command line, from which the plan of nodes follows) and
draws what the finished nodes say. To add one: a module here that ends with its record ``STUDY``,
and its place in the tuple below.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from flows.studies import (
    autopilot,
    caution,
    choices,
    collapse,
    dials,
    online,
    over_proximity,
    pace,
    trade_offs,
    world,
)
from flows.studies.study import Study

__all__ = ["STUDIES"]

STUDIES: Final[Mapping[str, Study]] = MappingProxyType(
    {
        study.name: study
        for study in (
            world.STUDY,
            online.STUDY,
            collapse.STUDY,
            *trade_offs.STUDIES,
            *over_proximity.STUDIES,
            choices.STUDY,
            autopilot.STUDY,
            dials.STUDY,
            caution.STUDY,
            pace.STUDY,
        )
    }
)
"""By name, in the order in which the door lists them."""
