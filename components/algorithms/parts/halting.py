"""Virtual trajectories that may halt, and the samples that MOReL learns from.

A trajectory that has entered HALT, see :mod:`.pessimistic_mdp`, is still continued in memory, so
that all lanes keep one shape, but its later steps are not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from components.algorithms.parts.advantages import generalised_advantages, whitened

__all__ = ["Halted", "Rollouts", "Trajectories", "by_sample", "live_samples", "with_halt"]


@dataclass(frozen=True)
class Halted:
    """Trajectories in the pessimistic process, ``[T, L, B]`` each.

    Attributes:
        rewards: Of the model; at the step into HALT the discounted sum of all rewards in HALT.
        alive: Whether the step counts: true up to and including the step into HALT.
        halts: Whether the step is the one into HALT, which is terminal.
    """

    rewards: Tensor
    alive: Tensor
    halts: Tensor

    @property
    def continues(self) -> Tensor:
        """0 where the next state is terminal, 1 elsewhere; the horizon's end is a time-out."""
        return 1.0 - self.halts.float()


def with_halt(
    rewards: Tensor, disagreements: Tensor, threshold: Tensor, halt_reward: Tensor, discount: float
) -> Halted:
    """End trajectories at their first unknown step.

    Args:
        rewards: ``[T, L, B]`` of the model.
        disagreements: Disagreement of the members about each step, of the same shape.
        threshold: ``[L]``; a step whose disagreement is above it, or undefined, is unknown.
        halt_reward: ``[L]`` per step in HALT; the infinite discounted sum is paid at once.
        discount: gamma.
    """
    unknown = ~(disagreements <= threshold[:, None])
    before = unknown.cumsum(dim=0) - unknown.long()
    alive = before == 0
    halts = unknown & alive
    halt_return = (halt_reward / (1.0 - discount))[:, None]
    return Halted(torch.where(halts, halt_return, rewards), alive, halts)


def live_samples(alive: Tensor, order: Tensor) -> Tensor:
    """Numbers of live samples ``[L, N]`` in random order, repeated where they are fewer than N.

    The number of live samples differs among lanes, whose tensors must have one shape. A minibatch
    without live samples would still move parameters, by momentum and weight decay.

    Args:
        alive: ``[L, N]``, at least one true in every lane.
        order: ``[L, N]`` a random permutation per lane.
    """
    dead = ~alive.gather(1, order)
    live_first = order.gather(1, dead.int().argsort(dim=1, stable=True))
    counts = alive.sum(dim=1, keepdim=True)
    return live_first.gather(1, torch.arange(alive.shape[1], device=alive.device) % counts)


class Trajectories:
    """Frames of virtual trajectories, from which observations are gathered on demand.

    Histories overlap: stored observations would take H times the memory.

    Args:
        begin: ``[L, B, H * F]`` observations at the start, newest frame first.
        frames: T frames ``[L, B, F]`` after each step, oldest first.
    """

    def __init__(self, begin: Tensor, frames: Sequence[Tensor]) -> None:
        self.steps, self._width = len(frames), frames[0].shape[-1]
        self._seen = begin.shape[-1]
        self._table = torch.cat([*reversed(frames), begin], dim=-1)  # newest first
        lanes, self._batch, _ = begin.shape
        self._lane = torch.arange(lanes, device=begin.device)[:, None]

    def observations(self, index: Tensor) -> Tensor:
        """Observations ``[L, N, H * F]``; number ``t * B + b`` is trajectory b's at time t.

        Times are 0, before the first step, to T, after the last one.
        """
        per_trajectory = self._table.shape[-1] // self._width
        trajectory = self._lane * self._batch + index % self._batch
        rows = trajectory * per_trajectory + self.steps - index // self._batch
        windows = self._table.as_strided(
            (self._table.numel() // self._width - self._seen // self._width + 1, self._seen),
            (self._width, 1),
        )
        return windows.index_select(0, rows.flatten()).view(*index.shape, self._seen)


@dataclass(frozen=True)
class Rollouts:
    """One update's trajectories; sample ``t * B + b`` is trajectory b's step t.

    Attributes:
        states: Frames, for the observations.
        noise: ``[L, T * B, A]`` with which the actions were drawn.
        values: ``[T + 1, L, B]`` of the baseline.
        ended: Rewards, and the steps at which trajectories halt.
        returns: ``[T, L, B]`` from every step on.
        saturated: ``[L]`` share of action entries on a bound.
    """

    states: Trajectories
    noise: Tensor
    values: Tensor
    ended: Halted
    returns: Tensor
    saturated: Tensor

    def weights(self, discount: float, trace: float) -> Tensor:
        """Weight of every sample's log density in the objective, ``[L, T * B]``.

        Args:
            discount: gamma.
            trace: lambda of the advantages.
        """
        ended = self.ended
        estimates = generalised_advantages(
            ended.rewards, self.values, ended.continues, discount, trace
        )
        alive = by_sample(ended.alive)
        return whitened(by_sample(estimates), alive) / alive.sum(dim=1, keepdim=True)


def by_sample(x: Tensor) -> Tensor:
    """``[T, L, B]`` as ``[L, T * B]``."""
    return x.transpose(0, 1).flatten(1)
