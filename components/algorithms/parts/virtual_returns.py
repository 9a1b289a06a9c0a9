"""Returns of virtual trajectories in the scale of the log, which LION and model_based maximise."""

from collections.abc import Callable, Iterator
from typing import Final

import torch
from torch import Tensor

from components.algorithms.parts.caution import MEASURES, Caution
from components.algorithms.parts.learner import LearnerInputs
from components.core.draws import Choice, Draw
from components.data.starts import spread_starts, start_rows
from components.models.mlp_ensemble.ensemble import MLPEnsemble, MLPTransition
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.transition.interface import TransitionModel
from components.models.transition.model_environment import (
    ModelEnvironment,
    Propagation,
    RolloutStep,
    discounted_sum,
)

__all__ = ["AGGREGATIONS", "TRANSITIONS", "VirtualReturns"]

TRANSITIONS: Final = ("recurrent_ensemble", "deterministic_ensemble")
"""Models in which virtual trajectories can be made here."""

AGGREGATIONS: Final = ("minimum", "mean", "single")
"""How members become one: the one of least reward in every step, their mean, the first alone."""


class VirtualReturns:
    """Differentiable returns on ensembles.

    Args:
        inputs: Data and ensembles of the lanes.
        horizon: Steps of a trajectory.
        discount: gamma.
        transition: The ensembles, one of `TRANSITIONS`.
        scale: By which returns are divided; None: by the size of the log's own mean return.
        aggregation: What becomes of the members' predictions, one of `AGGREGATIONS`.

    Attributes:
        scale: ``[L, 1]`` the same for every lane.
    """

    def __init__(
        self,
        inputs: LearnerInputs,
        horizon: int,
        discount: float,
        transition: str = TRANSITIONS[0],
        scale: float | None = None,
        aggregation: str = AGGREGATIONS[0],
    ) -> None:
        self._data, self._horizon, self._discount = inputs.data, horizon, discount
        self._aggregation = aggregation
        device = inputs.data.device
        self._scaling = scaling = inputs.data.frame_scaling
        model: TransitionModel
        if transition == "recurrent_ensemble":
            model = RecurrentTransition(inputs.fitted(transition, RecurrentEnsemble), device)
        else:
            model = MLPTransition(inputs.fitted(transition, MLPEnsemble), scaling, device)
        self._environment = ModelEnvironment(model, inputs.dynamics, scaling, device)
        logged = torch.tensor(inputs.mean_window_returns, device=device).abs()[:, None]
        self.scale = logged if scale is None else torch.full_like(logged, scale)
        self._caution: Caution | None = None

    def be_cautious(
        self,
        price: float | None,
        behaviour: Callable[[Tensor], Tensor],
        window: int,
        after: int,
        measure: str = MEASURES[0],
    ) -> None:
        """Price what leaves the support of the log, see :mod:`.caution`.

        Args:
            price: None: it costs nothing, and nothing is measured.
            behaviour: What the behaviour policy does; what it visits is familiar.
            window: Start states, see :func:`components.data.starts.start_rows`.
            after: Likewise.
            measure: By what the support is told.
        """
        if price is None:
            return
        caution = Caution(self._data, self._scaling, measure)
        starts = spread_starts(self._data, window, after)
        with torch.no_grad():
            caution.familiar(list(self._unroll(starts, behaviour)))
        self._caution, self._price = caution, price

    def start_draw(self, batch: int, window: int, after: int) -> Draw:
        """Drawing rule of start states, see :func:`components.data.starts.start_rows`."""
        starts = [start_rows(dataset, window, after) for dataset in self._data.datasets]
        return Choice(starts, batch)

    def of(self, start: Tensor, act: Callable[[Tensor], Tensor]) -> Tensor:
        """Scaled discounted returns ``[L, B]`` from the logged states ``start [L, B]`` on.

        With caution its price is taken off.
        """
        steps = list(self._unroll(start, act))
        returns = discounted_sum([step.rewards for step in steps], self._discount) / self.scale
        if self._caution is None:
            return returns
        return returns - self._price * self._caution.excess(steps, self._discount)

    def _unroll(self, start: Tensor, act: Callable[[Tensor], Tensor]) -> Iterator[RolloutStep]:
        past = self._data.start_states(start, self._environment.model.memory)
        return self._environment.unroll(*past, act, self._horizon, self._propagation(start))

    def _propagation(self, start: Tensor) -> Propagation:
        """How trajectories from ``start [L, B]`` on are continued."""
        if self._aggregation == "single":
            return torch.zeros(self._horizon, *start.shape, dtype=torch.int64, device=start.device)
        return "mean" if self._aggregation == "mean" else "minimum"
