"""Returns of virtual trajectories in the scale of the log: what LION and its control maximise."""

from collections.abc import Callable

import torch
from torch import Tensor

from components.algorithms.parts.learner import LearnerInputs, first_rows
from components.core.random_streams import Draw
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.transition.model_environment import ModelEnvironment, discounted_sum

__all__ = ["VirtualReturns"]


class VirtualReturns:
    """Differentiable returns on recurrent ensembles, every step taking the least reward.

    Args:
        parts: Data and ensembles of the lanes.
        horizon: Steps of a trajectory.
        discount: gamma.

    Attributes:
        scale: ``[L, 1]`` size of the log's own mean return, by which returns are divided.
    """

    def __init__(self, parts: LearnerInputs, horizon: int, discount: float) -> None:
        self._data, self._horizon, self._discount = parts.data, horizon, discount
        device = parts.data.device
        ensembles = parts.fitted("recurrent_ensemble", RecurrentEnsemble)
        self._machine = ModelEnvironment(
            RecurrentTransition(ensembles, device), parts.machine, parts.data.frame_scaling, device
        )
        self.scale = torch.tensor(parts.mean_window_returns, device=device).abs()[:, None]

    def start_draw(self, batch: int, window: int, after: int) -> Draw:
        """Drawing rule of start states, see :func:`.learner.first_rows`."""
        starts = [first_rows(dataset, window, after) for dataset in self._data.datasets]
        return lambda g, lane, steps: g.choice(starts[lane], size=(steps, batch))

    def of(self, start: Tensor, act: Callable[[Tensor], Tensor]) -> Tensor:
        """Scaled discounted returns ``[L, B]`` from the logged states ``start [L, B]`` on."""
        past = self._data.start_states(start, self._machine.model.memory)
        steps = self._machine.unroll(*past, act, self._horizon)
        return discounted_sum([step.rewards for step in steps], self._discount) / self.scale
