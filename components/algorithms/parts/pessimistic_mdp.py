"""The pessimistic MDP of MOReL: a model environment that halts where its models disagree.

Kidambi et al., "MOReL: Model-Based Offline Reinforcement Learning" (2020). Where the members of an
ensemble disagree by more than a threshold the next state is unknown, and the process enters HALT:
an absorbing state that pays a little less than the worst logged reward, for ever.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from components.algorithms.parts.halting import Halted, Trajectories, with_halt
from components.data.batches import LaneData
from components.models.transition.interface import Prediction
from components.models.transition.model_environment import ModelEnvironment

__all__ = [
    "Detector",
    "PessimisticMDP",
    "disagreement",
]

CHUNK = 4096  # logged transitions of all lanes evaluated at once, which limits the memory


def disagreement(prediction: Prediction, target_scale: Tensor) -> Tensor:
    """Largest distance between the predictions of two members, ``[L, B]``.

    Measured on standardised targets of the newest frame: raw units differ by orders of magnitude,
    and the rest of a history follows exactly, by a shift.

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
        environment: The lanes' model environment.
        data: The lanes' datasets.
        beta: Deviations above the mean that still count as known.

    Raises:
        ValueError: If there are fewer than two members, which cannot disagree.
    """

    threshold: Tensor  # [L]
    known_share: Tensor  # [L] of the logged pairs that lie within the threshold

    def __init__(self, environment: ModelEnvironment, data: LaneData, beta: float) -> None:
        super().__init__()
        if environment.model.members < 2:
            raise ValueError("A single member cannot disagree: the ensemble needs members=2.")
        self._scale = environment.model.target_scale
        logged = [lane.double() for lane in self._logged(environment, data)]
        threshold = torch.stack([d.mean() + beta * d.std(correction=0) for d in logged])
        known = [(d <= t).double().mean() for d, t in zip(logged, threshold, strict=True)]
        self.register_buffer("threshold", threshold.float())
        self.register_buffer("known_share", torch.stack(known).float())

    def forward(self, prediction: Prediction) -> Tensor:
        """Disagreement ``[L, B]`` about a step."""
        return disagreement(prediction, self._scale)

    @torch.no_grad()
    def _logged(self, environment: ModelEnvironment, data: LaneData) -> list[Tensor]:
        """Disagreement about every logged pair, one vector per lane."""
        longest = torch.arange(max(data.counts), device=data.device)
        last = torch.tensor(data.counts, device=data.device)[:, None] - 1
        found = torch.empty(data.lanes, len(longest), device=data.device)
        for rows in longest.split(max(1, CHUNK // data.lanes)):
            index = torch.minimum(rows, last)  # shorter logs repeat their last row, cut off below
            past = data.start_states(index, environment.model.memory)
            [step] = environment.unroll(*past, partial(_acting, data.actions(index)), 1)
            found[:, rows] = self(step.prediction)
        return [lane[:count] for lane, count in zip(found, data.counts, strict=True)]


def _acting(actions: Tensor, observations: Tensor) -> Tensor:
    """A policy of given actions, whatever the observations."""
    return actions


class PessimisticMDP:
    """The model environment of L lanes with HALT in it.

    Args:
        environment: The model environment.
        detector: Of states unknown to its models.
        followed: ``[T, L, B]`` the members that trajectories follow.
        halt_reward: ``[L]`` per step in HALT.
        discount: gamma.
    """

    def __init__(
        self,
        environment: ModelEnvironment,
        detector: Detector,
        followed: Tensor,
        halt_reward: Tensor,
        discount: float,
    ) -> None:
        self._environment, self._detector, self._followed = environment, detector, followed
        self._halt_reward, self._discount = halt_reward, discount

    @property
    def memory(self) -> int:
        """Model frames that trajectories begin with."""
        return self._environment.model.memory

    @torch.no_grad()
    def roll_out(
        self,
        begin: Tensor,
        past: Tensor,
        act: Callable[[Tensor], Tensor],
    ) -> tuple[Trajectories, Halted]:
        """Let policies act for T steps; halted trajectories are continued, but not used.

        An undefined prediction is unknown and halts a trajectory. Zeros replace what the models
        have left undefined: a weight of 0 does not, as 0 times an undefined number is undefined.

        Args:
            begin: ``[L, B, H * F]`` observations at the start.
            past: ``[L, B, G, M]`` model frames up to there, as logged.
            act: As in :meth:`ModelEnvironment.unroll`.
        """
        frames, rewards, disagreements = [], [], []
        for step in self._environment.unroll(begin, past, act, len(self._followed), self._followed):
            frames.append(_defined(step.frames))
            rewards.append(_defined(step.rewards))
            disagreements.append(self._detector(step.prediction))
        ended = with_halt(
            torch.stack(rewards),
            torch.stack(disagreements),
            self._detector.threshold,
            self._halt_reward,
            self._discount,
        )
        return Trajectories(begin, frames), ended


def _defined(x: Tensor) -> Tensor:
    return torch.where(x.isfinite(), x, 0.0)
