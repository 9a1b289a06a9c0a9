"""What a dataset costs: core-seconds at the default sizes, measured roughly on a computer of 2026.

Costs order the work and open the estimate; once nodes have finished, their times replace these.
Those of models and policies are in the records of :data:`components.models.MODELS` and
:data:`components.algorithms.ALGORITHMS`.
"""

from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog

__all__ = ["data_cost"]


def data_cost(spec: IndustrialSpec | RobotSpec | StoredLog) -> float:
    """Core-seconds of a dataset."""
    if isinstance(spec, StoredLog):
        return 0.1 + 1e-7 * spec.card.transitions
    if isinstance(spec, RobotSpec):
        return 1.5e-4 * spec.transitions
    return 1e-5 * spec.trajectories * spec.steps
