"""What nodes cost: core-seconds at the default sizes on a machine of 2026, measured roughly.

They order the work and open the estimate; once nodes have finished, their times replace these.
"""

from itertools import pairwise
from typing import Any

from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog
from components.models.mlp_ensemble.config import MLPEnsembleConfig

__all__ = ["data_cost", "model_cost", "policy_cost"]

_ROW_COST = {
    "bc": 6e-6,
    "ddpg": 2.2e-5,
    "bcq": 3.3e-4,
    "bear": 1.7e-4,
    "brac": 6.5e-5,
    "cql": 5.8e-4,
    "td3_bc": 2.5e-5,
    "lambda_td3_bc": 2.5e-5,
    "rvs": 6e-5,
    "mopo": 5.6e-5,
}
"""Per transition of a batch."""


def data_cost(spec: IndustrialSpec | RobotSpec | StoredLog) -> float:
    """Core-seconds of a dataset."""
    if isinstance(spec, StoredLog):
        return 0.1 + 1e-7 * spec.card.transitions
    if isinstance(spec, RobotSpec):
        return 1.5e-4 * spec.transitions
    return 1e-5 * spec.trajectories * spec.steps


def model_cost(name: str, model: Any) -> float:
    """Core-seconds of a fit."""
    if name == "recurrent_ensemble":
        steps = model.warm_up + model.horizon
        return 3.4e-7 * model.updates * model.batch * model.members * 2 * steps * model.hidden / 30
    if isinstance(model, MLPEnsembleConfig):
        widths = (184, *model.hidden, 2)  # 30 frames and the next inputs; fatigue and consumption
        weights = sum(inputs * outputs for inputs, outputs in pairwise(widths))
        return 6.5e-6 * model.epochs * model.members * len(model.forms) * weights
    if name == "action_vae":
        return 7.5 * float(model.epochs)
    return 0.5 * float(model.epochs)


def policy_cost(algorithm: str, config: Any) -> float:
    """Core-seconds of a training run of one seed."""
    if algorithm == "lion":
        return 1.4e-5 * float(config.updates * config.trajectories * config.horizon)
    if algorithm == "model_based":
        return 9e-6 * float(config.updates * config.trajectories * config.horizon)
    if algorithm == "moose":
        return 2.7e-4 * float(config.updates * config.trajectories * config.horizon)
    if algorithm == "wsbc":
        return 9e-7 * float(config.updates * config.particles * config.starts * config.horizon)
    if algorithm == "morel":
        steps = config.updates * config.trajectories * config.horizon
        return 2.3e-4 * float(steps) + 2.2e-3 * float(config.cloning)
    if algorithm == "mopo":
        updates = _ROW_COST["mopo"] * float(config.updates * config.batch)
        rounds = -(-config.updates // config.rollout_every)
        return updates + 3.5e-5 * float(rounds * config.rollouts * config.rollout_length)
    return _ROW_COST[algorithm] * float(config.updates * config.batch)
