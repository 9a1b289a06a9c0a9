"""Fits of supervised models: minibatches, a schedule, held-out losses, the best state kept.

A model provides a stack of networks, a loss and a validation. :class:`StackedFit` steps all lanes
at once (datasets, ensemble members), keeps for every lane the weights of its lowest held-out loss
and stops when no lane has improved for a while. Interrupted fits continue to the same numbers.

Only finite weights of a finite loss are kept. A fit whose loss is infinite or undefined from some
update on has the best state before that, and says so; one that never had any has diverged. A fit
whose best state is no better than the untrained network says that, too.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from components.core.random_streams import LaneStreams
from components.training.cuda_graphs import graphed
from components.training.divergence import DivergedError
from components.training.loop import Curves, TrainingLoop, adam
from components.training.schedule import Schedule
from components.training.state import (
    load_optimizer_state,
    module_state,
    optimizer_state,
    prefixed,
    with_prefix,
)

__all__ = [
    "SCHEDULES",
    "UNWATCHED",
    "Fit",
    "Fitted",
    "Monitor",
    "Series",
    "StackedFit",
    "ended_at",
    "improved",
    "nothing_learned",
]

Series = tuple[Sequence[int], Sequence[float]]
"""Steps and values of a learning curve."""

SCHEDULES = ("constant", "cosine")
"""Learning rates over the budget: as given, or falling to zero along half a cosine."""


class Fitted(Protocol):
    """A fitted model that can be stored."""

    def save(self, folder: Path) -> None:
        """Write the artifact into an existing folder."""


M_co = TypeVar("M_co", bound=Fitted, covariant=True)


@dataclass(frozen=True)
class Fit(Generic[M_co]):
    """What a fit returns.

    Attributes:
        model: The fitted model, in its state of lowest held-out loss.
        validation_loss: Its loss on held-out trajectories, what hyperparameter search minimises.
        metrics: Further numbers by name.
        curves: Learning curves by name.
        ended_at: Update by which a loss had become infinite or undefined. None: it never did.
    """

    model: M_co
    validation_loss: float
    metrics: Mapping[str, float]
    curves: Mapping[str, Series]
    ended_at: int | None = None


@dataclass(frozen=True)
class Monitor:
    """Callbacks during a fit.

    Attributes:
        progress: Called with the finished fraction of the budget, 0 to 1.
        validated: Called with the finished fraction and the held-out loss after every validation;
            an exception that it raises ends the fit, e.g. when a search prunes a trial.
    """

    progress: Callable[[float], None] = lambda fraction: None
    validated: Callable[[float, float], None] = lambda fraction, loss: None


UNWATCHED = Monitor()

N = TypeVar("N", bound=nn.Module)


def improved(losses: Tensor, least: Tensor, parameters: Sequence[Tensor]) -> Tensor:
    """Lanes whose state is worth keeping: finite, with a finite loss below their least, ``[L]``.

    Args:
        losses: Held-out losses ``[L]``.
        least: What they must be below, ``[L]``.
        parameters: Lanes first; a parameter may hold several rows a lane.
    """
    better = losses.isfinite() & (losses < least)
    for parameter in parameters:
        better &= parameter.detach().reshape(len(losses), -1).isfinite().all(dim=1)
    return better


def ended_at(curves: Curves, best_loss: Tensor, lanes: slice = slice(None)) -> int | None:
    """First update at which a loss of some lanes was infinite or undefined, if there is one.

    Args:
        curves: Of all lanes.
        best_loss: Lowest held-out losses ``[L]``; infinite where there never was a finite one.
        lanes: Those of the model.

    Raises:
        DivergedError: One of them never had a finite state of finite held-out loss.
    """
    if not bool(best_loss[lanes].isfinite().all()):
        raise DivergedError("its held-out loss was never finite")
    ends = [curves.ended_at(lane) for lane in range(len(best_loss))[lanes]]
    return min((end for end in ends if end is not None), default=None)


def nothing_learned(best_loss: Tensor, untrained_loss: Tensor) -> dict[str, float]:
    """The metric `training/untrained_loss` of a fit of which a lane never got below it, else none.

    Args:
        best_loss: Lowest held-out losses ``[L]``.
        untrained_loss: Held-out losses before the first update ``[L]``.
    """
    if bool((best_loss >= untrained_loss).any()):
        return {"training/untrained_loss": float(untrained_loss.mean())}
    return {}


class StackedFit(Generic[N]):
    """Trains a stack of networks and keeps the weights of lowest held-out loss, lane by lane.

    Args:
        network: Lanes first in every parameter; a parameter may hold several rows a lane.
        lanes: L.
        loss: Training loss ``[L]`` and further metrics ``[L]`` of a network on the numbers drawn
            for a step.
        streams: Draws those numbers.
        learning_rate: Of Adam, at the start.
        schedule: Name in :data:`SCHEDULES`.
        weight_decay: L2 term inside Adam.
    """

    updates_per_graph = 50

    def __init__(
        self,
        network: N,
        lanes: int,
        loss: Callable[[N, Mapping[str, Tensor]], tuple[Tensor, dict[str, Tensor]]],
        streams: LaneStreams,
        *,
        learning_rate: float,
        schedule: str = "constant",
        weight_decay: float = 0.0,
    ) -> None:
        self.network, self.lanes = network, lanes
        self.best = copy.deepcopy(network)
        device = next(network.parameters()).device
        self.best_loss = torch.full((lanes,), math.inf, device=device)
        self.untrained_loss = torch.full_like(self.best_loss, math.inf)
        self.stale = torch.zeros(lanes, device=device)  # validations since a lane's best
        self._loss, self._streams = loss, streams
        self._learning_rate, self._falls, self._updates = learning_rate, schedule == "cosine", 1
        self._optimizer = adam(list(network.parameters()), learning_rate, weight_decay)
        self._schedule = Schedule(self._optimizer, self._rate)

    def run(
        self,
        validate: Callable[[N], Tensor],
        names: Sequence[str],
        *,
        updates: int,
        validate_every: int,
        patience: int | None = None,
        improvement: float = 0.0,
        overall: Callable[[Tensor], Tensor] = torch.mean,
        checkpoint: Path | None = None,
        monitor: Monitor = UNWATCHED,
    ) -> Curves:
        """Train until the budget is spent or no lane improves any more.

        Args:
            validate: Held-out loss ``[L]`` of a network.
            names: Names of the lanes, stable across restarts.
            updates: Budget.
            validate_every: Updates between validations; the last update is validated too.
            patience: Validations in a row without improvement of any lane before training stops.
            improvement: Smallest relative improvement that counts.
            overall: One loss for the monitor from those of the lanes' best states ``[L]``.
            checkpoint: File to resume from and save to.
            monitor: Receives the progress and the overall held-out loss.

        Returns:
            The learning curves.
        """
        self._updates = updates
        with torch.no_grad():  # before a checkpoint replaces the weights
            self.untrained_loss = validate(self.network)

        def after(done: int, curves: Curves) -> bool:
            with torch.no_grad():
                losses = validate(self.network)
            curves.add(done, {"model/validation_loss": losses})
            self._keep_best(losses, improvement)
            monitor.validated(done / updates, float(overall(self.best_loss)))
            return patience is not None and bool((self.stale >= patience).all())

        loop = TrainingLoop(
            updates, names, checkpoint, log_every=validate_every, progress=monitor.progress
        )
        validated = {*range(validate_every, updates, validate_every), updates}
        return loop.run(graphed(self, self.best_loss.device), after, validated)

    def branch(self, step: int) -> str:
        """All updates belong to one branch."""
        return "all"

    def stage(self, first: int, count: int) -> None:
        """Tell CUDA graphs which steps come next, and their learning rates."""
        self._streams.stage(first, count)
        if self._falls:
            self._schedule.stage(first, count)

    def draw(self, first: int, count: int) -> None:
        """Draw the numbers of the steps that were staged."""
        self._streams.draw(count)

    def _rate(self, step: int) -> float:
        return self._learning_rate * 0.5 * (1.0 + math.cos(math.pi * step / self._updates))

    def update(self, step: int) -> dict[str, Tensor]:
        """One step of all lanes down their training losses."""
        if self._falls:
            self._schedule.follow(step)
        loss, metrics = self._loss(self.network, self._streams.at(step))
        self._optimizer.zero_grad(set_to_none=True)
        loss.sum().backward()
        self._optimizer.step()
        return {"model/train_loss": loss.detach()} | metrics

    @torch.no_grad()
    def _keep_best(self, losses: Tensor, improvement: float) -> None:
        # The first finite loss is below infinity times any factor, so it always counts.
        least = self.best_loss * (1.0 - improvement)
        better = improved(losses, least, list(self.network.parameters()))
        self.best_loss = torch.where(better, losses, self.best_loss)
        self.stale = torch.where(better, torch.zeros_like(self.stale), self.stale + 1)
        for kept, new in zip(self.best.parameters(), self.network.parameters(), strict=True):
            rows = better.repeat_interleave(new.shape[0] // self.lanes)
            kept.copy_(torch.where(rows.view(-1, *[1] * (new.ndim - 1)), new, kept))

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next update depends on, lane axis first in every tensor."""
        state = module_state({"network": self.network, "best": self.best})
        state |= {"best_loss": self.best_loss, "stale": self.stale}
        return state | prefixed("optimizer", optimizer_state(self._optimizer))

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.network.load_state_dict(with_prefix("network", state))
        self.best.load_state_dict(with_prefix("best", state))
        self.best_loss.copy_(state["best_loss"])
        self.stale.copy_(state["stale"])
        load_optimizer_state(self._optimizer, with_prefix("optimizer", state))
