"""The defaults of algorithms, models, evaluation, expert training and dataset indicators.

They stand in the dataclasses of the components and nowhere else. The files of conf/ and a command
line override them.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from components.algorithms import ALGORITHMS
from components.evaluation.protocol import EvaluationProtocol
from components.experts.config import ExpertConfig
from components.judging.config import JudgeConfig
from components.models import MODELS
from components.models.action_stochasticity import StochasticityConfig

__all__ = ["ALGORITHM_CONFIGS", "MODEL_CONFIGS", "component_defaults"]

ALGORITHM_CONFIGS: Mapping[str, type] = {
    name: ALGORITHMS[name].config for name in sorted(ALGORITHMS)
}
"""Configuration classes of the algorithms, sorted by name."""

MODEL_CONFIGS: Mapping[str, type] = {name: MODELS[name].config for name in sorted(MODELS)}
"""Configuration classes of the supervised models, sorted by name."""


def component_defaults() -> dict[str, Any]:
    """The default of every component setting, in the groups of the command line."""
    return {
        "algorithm": {name: asdict(kind()) for name, kind in ALGORITHM_CONFIGS.items()},
        "model": {name: asdict(kind()) for name, kind in MODEL_CONFIGS.items()},
        "evaluation": asdict(EvaluationProtocol()),
        "experts": {"training": asdict(ExpertConfig())},
        "judging": {"estimates": asdict(JudgeConfig())},
        "ranking": {"stochasticity": asdict(StochasticityConfig())},
    }
