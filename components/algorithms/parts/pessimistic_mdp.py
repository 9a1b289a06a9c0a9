"""The pessimistic decision process of MOReL: unknown states, and the trajectories that end in them.

Kidambi et al., "MOReL: Model-Based Offline Reinforcement Learning" (2020). Where the members of an
ensemble disagree by more than a threshold the next state is unknown, and the process enters HALT:
an absorbing state that pays a little less than the worst logged reward, for ever.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from components.data.batches import LaneData
from components.data.frame_table import FrameTable
from components.models.transition.interface import Prediction
from components.models.transition.model_environment import ModelEnvironment

__all__ = [
    "Detector",
    "Halted",
    "PessimisticMDP",
    "Trajectories",
    "disagreement",
    "live_samples",
    "with_halt",
]

CHUNK = 4096  # logged transitions of all lanes judged at once, which limits the memory


def disagreement(prediction: Prediction, target_scale: Tensor) -> Tensor:
    """Largest distance between the predictions of two members, ``[L, B]``.

    Measured on standardised targets of the newest frame: raw units differ by orders of magnitude,
    and the rest of a history is a shift that no member can be wrong about.

    Args:
        prediction: Of K members.
        target_scale: ``[L, D]`` one standardised target.
    """
    values = prediction.values / target_scale[:, :, None, None]
    members = values.shape[2]
    first, second = torch.triu_indices(members, members, offset=1, device=values.device)
    return (values[:, :, first] - values[:, :, second]).square().sum(dim=1).amax(dim=1).sqrt()


class Detector(nn.Module):
    """Unknown-state detectors of L lanes; a module, so that thresholds are part of the state.

    ``threshold = mean + beta * std`` of the disagreement over all logged state-action pairs.

    Args:
        machine: The lanes' learned machine.
        data: The lanes' datasets.
        beta: Caution; the lower, the more is unknown.

    Raises:
        ValueError: If there are fewer than two members, which cannot disagree.
    """

    threshold: Tensor  # [L]
    known_share: Tensor  # [L] of the logged pairs that lie within the threshold

    def __init__(self, machine: ModelEnvironment, data: LaneData, beta: float) -> None:
        super().__init__()
        if machine.model.members < 2:
            raise ValueError("A single member cannot disagree: the ensemble needs members=2.")
        self._scale = machine.model.target_scale
        logged = [doubts.double() for doubts in self._logged(machine, data)]
        threshold = torch.stack([d.mean() + beta * d.std(correction=0) for d in logged])
        known = [(d <= t).double().mean() for d, t in zip(logged, threshold, strict=True)]
        self.register_buffer("threshold", threshold.float())
        self.register_buffer("known_share", torch.stack(known).float())

    def forward(self, prediction: Prediction) -> Tensor:
        """Disagreement ``[L, B]`` about a step."""
        return disagreement(prediction, self._scale)

    @torch.no_grad()
    def _logged(self, machine: ModelEnvironment, data: LaneData) -> list[Tensor]:
        """Disagreement about every logged pair, one vector per lane."""
        longest = torch.arange(max(data.counts), device=data.device)
        last = torch.tensor(data.counts, device=data.device)[:, None] - 1
        found = torch.empty(data.lanes, len(longest), device=data.device)
        for rows in longest.split(max(1, CHUNK // data.lanes)):
            index = torch.minimum(rows, last)  # shorter logs repeat their last row, cut off below
            past = data.start_states(index, machine.model.memory)
            [step] = machine.unroll(*past, partial(_acting, data.actions(index)), 1)
            found[:, rows] = self(step.prediction)
        return [doubts[:count] for doubts, count in zip(found, data.counts, strict=True)]


def _acting(actions: Tensor, observations: Tensor) -> Tensor:
    """A policy that has decided before it sees anything."""
    return actions


@dataclass(frozen=True)
class Halted:
    """Trajectories in the pessimistic process, ``[T, L, B]`` each.

    Attributes:
        rewards: Those of the model; at the step into HALT everything HALT will ever pay.
        alive: Whether the step is taken at all: up to and including the one into HALT.
        halts: Whether it is the one into HALT, which is terminal.
    """

    rewards: Tensor
    alive: Tensor
    halts: Tensor

    @property
    def continues(self) -> Tensor:
        """0 where the next state is terminal, 1 elsewhere; the horizon's end is a time-out."""
        return 1.0 - self.halts.float()


def with_halt(
    rewards: Tensor, doubts: Tensor, threshold: Tensor, halt_reward: Tensor, discount: float
) -> Halted:
    """End trajectories at their first step into the unknown.

    Args:
        rewards: ``[T, L, B]`` of the model.
        doubts: Disagreement about each step, of the same shape.
        threshold: ``[L]``; what is above it, or undefined, is unknown.
        halt_reward: ``[L]`` per step in HALT; their discounted sum without end falls due at once.
        discount: gamma.
    """
    unknown = ~(doubts <= threshold[:, None])
    before = unknown.cumsum(dim=0) - unknown.long()
    alive = before == 0
    halts = unknown & alive
    due = (halt_reward / (1.0 - discount))[:, None]
    return Halted(torch.where(halts, due, rewards), alive, halts)


def live_samples(alive: Tensor, order: Tensor) -> Tensor:
    """Numbers of live samples ``[L, N]`` in random order, repeated where they are fewer than N.

    Lanes halt differently and must stay of one shape, and a minibatch without any live sample would
    leave an optimiser to its momentum and weight decay.

    Args:
        alive: ``[L, N]``, at least one true in every lane.
        order: ``[L, N]`` a random permutation per lane.
    """
    dead = ~alive.gather(1, order)
    live_first = order.gather(1, dead.int().argsort(dim=1, stable=True))
    counts = alive.sum(dim=1, keepdim=True)
    return live_first.gather(1, torch.arange(alive.shape[1], device=alive.device) % counts)


class Trajectories:
    """Frames of virtual trajectories, from which observations are put together when asked for.

    Histories overlap: stacked ones would take H times the memory.

    Args:
        begin: ``[L, B, H * F]`` observations at the start, newest frame first.
        frames: T frames ``[L, B, F]`` after each step, oldest first.
    """

    def __init__(self, begin: Tensor, frames: Sequence[Tensor]) -> None:
        self.steps, width = len(frames), frames[0].shape[-1]
        self._history = begin.shape[-1] // width  # H
        self._table = FrameTable(torch.cat([*reversed(frames), begin], dim=-1).view(-1, width))
        lanes, self._batch, _ = begin.shape
        self._lane = torch.arange(lanes, device=begin.device)[:, None]

    def observations(self, index: Tensor) -> Tensor:
        """Observations ``[L, N, H * F]``; number ``t * B + b`` is what trajectory b shows at t.

        Times go from 0, before the first step, to T, after the last one.
        """
        per_trajectory = self.steps + self._history
        trajectory = self._lane * self._batch + index % self._batch
        newest = trajectory * per_trajectory + self.steps - index // self._batch
        return self._table.windows(newest, self._history)


class PessimisticMDP:
    """The learned machine of L lanes with HALT in it.

    Args:
        machine: The learned machine.
        detector: Knows what is unknown to it.
        followed: ``[T, L, B]`` the members that trajectories follow.
        halt_reward: ``[L]`` per step in HALT.
        discount: gamma.
    """

    def __init__(
        self,
        machine: ModelEnvironment,
        detector: Detector,
        followed: Tensor,
        halt_reward: Tensor,
        discount: float,
    ) -> None:
        self._machine, self._detector, self._followed = machine, detector, followed
        self._halt_reward, self._discount = halt_reward, discount

    @property
    def memory(self) -> int:
        """Model frames that trajectories begin with."""
        return self._machine.model.memory

    @torch.no_grad()
    def roll_out(
        self,
        begin: Tensor,
        past: Tensor,
        act: Callable[[Tensor], Tensor],
    ) -> tuple[Trajectories, Halted]:
        """Let policies act for T steps; halted trajectories go on, but do not count any more.

        Args:
            begin: ``[L, B, H * F]`` observations at the start.
            past: ``[L, B, G, M]`` model frames up to there, as logged.
            act: As in :meth:`ModelEnvironment.unroll`.
        """
        frames, rewards, doubts = [], [], []
        for step in self._machine.unroll(begin, past, act, len(self._followed), self._followed):
            frames.append(step.frames)
            rewards.append(step.rewards)
            doubts.append(self._detector(step.prediction))
        ended = with_halt(
            torch.stack(rewards),
            torch.stack(doubts),
            self._detector.threshold,
            self._halt_reward,
            self._discount,
        )
        return Trajectories(begin, frames), ended
