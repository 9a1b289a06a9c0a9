"""What nodes cost: core-seconds, measured roughly on one core of a computer of 2026.

Costs order the work and open the estimate; once nodes have finished, their times scale these. Those
of models and policies are in the records of :data:`components.models.MODELS` and
:data:`components.algorithms.ALGORITHMS`, as functions of the settings and of the sizes of the data.
"""

from typing import Any

from components.data.sizes import DataSizes, weights
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog
from components.data.sources.world import WorldSpec
from components.environments.frame_history import HISTORY_LENGTH
from components.environments.industrial.benchmark import FRAME_FEATURES, STEERINGS
from components.environments.mujoco.specifications import ROBOTS
from components.environments.world.plane import COORDINATES, STEPS

__all__ = ["data_cost", "data_sizes", "evaluation_cost"]

Source = IndustrialSpec | RobotSpec | StoredLog | WorldSpec

_CALL = 0.05  # of anything, such as files
_PER_WEIGHT = 6e-11  # of a multiplication and an addition, when a policy acts on many states
_INDUSTRIAL_STEP, _ROBOT_STEP = 2e-6, 4e-5  # of a copy


def data_sizes(source: Source) -> DataSizes:
    """The sizes of a dataset, from its card or from what it will be made by."""
    if isinstance(source, StoredLog):
        card = source.card
        widths = card.history, len(card.frame_features), len(card.action_features)
        return DataSizes(*widths, card.transitions)
    if isinstance(source, RobotSpec):
        robot = ROBOTS[source.robot]
        widths = source.history, len(robot.frame_features), len(robot.action_features)
        return DataSizes(*widths, source.transitions)
    if isinstance(source, WorldSpec):
        return DataSizes(source.history, len(COORDINATES), len(STEPS), source.transitions)
    count = source.trajectories * source.steps
    return DataSizes(HISTORY_LENGTH, len(FRAME_FEATURES), len(STEERINGS), count)


def data_cost(source: Source) -> float:
    """Core-seconds of making a dataset."""
    if isinstance(source, StoredLog):
        return _CALL + 1e-7 * source.card.transitions
    if isinstance(source, RobotSpec):
        return _CALL + 1.5e-4 * source.transitions
    if isinstance(source, WorldSpec):
        return _CALL + _INDUSTRIAL_STEP * source.transitions
    return _CALL + _INDUSTRIAL_STEP * source.trajectories * source.steps


def evaluation_cost(config: Any, sizes: DataSizes, states: int, *, robot: bool) -> float:
    """Core-seconds of an evaluation.

    Args:
        config: Of the algorithm whose policy acts; one that chooses among drawn candidates passes
            all of them through its networks.
        sizes: Of the dataset.
        states: In which policies act, over all snapshots and proximities.
        robot: Whether the system is one, rather than the Industrial Benchmark.
    """
    acting = _PER_WEIGHT * weights(config, sizes) * getattr(config, "deployed_actions", 1)
    return _CALL + states * (acting + (_ROBOT_STEP if robot else _INDUSTRIAL_STEP))
