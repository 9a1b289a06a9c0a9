"""Unroll policies through a learned ensemble: the one place where virtual trajectories are made.

Every lane has its own ensemble of K members, its own policy and B trajectories. At each step the
policy acts, the known features of the model frame follow exactly (differentiably), every member
predicts the learned ones, and one prediction becomes the next frame, by default clipped to the
range of the training data. Policies see those of its features that the log's frames hold, see
:mod:`components.data.dynamics`. The propagation says which prediction that is:

- ``"minimum"``: per trajectory and step the member that predicts the lowest reward (thesis 6.4 and
  5.17);
- ``"mean"``: the mean of the members' clipped predictions, whose reward is the mean of theirs
  (the ablation of thesis figure 6.11); nothing is drawn from it;
- ``"isolated"``: every member continues its own copy of each trajectory (thesis 5.15);
- a tensor of member numbers per step and trajectory: a random elite at every step (MOPO), or one
  member for the whole trajectory (MOReL).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.dynamics import DynamicsSpecification
from components.models.transition.interface import Prediction, TransitionModel

__all__ = [
    "ModelEnvironment",
    "PredictionRange",
    "Propagation",
    "RolloutStep",
    "discounted_sum",
]

Act = Callable[[Tensor], Tensor]
Propagation = Literal["minimum", "mean", "isolated"] | Tensor
PredictionRange = Literal["data", "free"]


@dataclass(frozen=True)
class RolloutStep:
    """One step of N virtual trajectories a lane; N is B, or K * B (member-major) in isolation.

    Attributes:
        observations: ``[L, N, O]`` before the actions, scaled.
        actions: ``[L, N, A]``.
        rewards: ``[L, N]``.
        frames: ``[L, N, F]`` features of the next frame that policies see, in their scaling.
        prediction: Of all members, before the choice and the clipping.
        drawn: ``[L, D, S, B]`` normalised targets of the next frame, chosen or sampled, before the
            clipping; S is 1, or K in isolation.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    frames: Tensor
    prediction: Prediction
    drawn: Tensor


class ModelEnvironment:
    """The model environments of L lanes.

    Args:
        model: The lanes' ensembles.
        dynamics: How known features follow from actions, and what the reward is.
        scaling: Scaling of the frames that policies see, ``[L, F]``.
        device: Where to compute.
        prediction_range: ``data`` clips predictions to the range of the training data, ``free``
            takes them as they are.
    """

    def __init__(
        self,
        model: TransitionModel,
        dynamics: DynamicsSpecification,
        scaling: Normaliser,
        device: torch.device,
        prediction_range: PredictionRange = "data",
    ) -> None:
        self.model = model
        frames = model.frames
        self._scaling = scaling.to(device)
        self._dynamics, self._observed = dynamics, slice(*dynamics.observed)
        self._keep, self._scale = (
            torch.tensor(numbers, device=device)[:, None, None]
            for numbers in (dynamics.keep, dynamics.scale)
        )
        reward = torch.tensor(dynamics.reward, device=device)
        count = len(dynamics.known)
        # Features that no action moves, those that one does, and the learned ones.
        acted = len(dynamics.scale)
        self._parts = [count - acted, acted, len(dynamics.learned)]
        self._known_mean, self._known_scale = (
            _wide(moment[:, :count]) for moment in (frames.mean, frames.scale)
        )
        mean, scale = frames.mean[:, count:], frames.scale[:, count:]
        # Reward of a normalised prediction: weights times scale, and the part of the means.
        self._reward_weight, self._reward_offset = reward * scale, (reward * mean).sum(dim=1)
        self._learned_mean, self._learned_scale = _wide(mean), _wide(scale)
        self._low, self._high = _wide(model.low), _wide(model.high)
        if prediction_range == "free":
            self._low, self._high = (torch.full_like(self._low, s * torch.inf) for s in (-1, 1))
        self._target_scale = _wide(model.target_scale)

    @property
    def frame_range(self) -> Tensor:
        """Ends between which predictions are held, ``[2, L, F]``, in the units of the log.

        They are infinite for features that follow the actions or never move.
        """
        ends = []
        for bound, sign in ((self._low, -1), (self._high, 1)):
            own = (bound * self._learned_scale + self._learned_mean)[:, :, 0, 0]
            known = torch.full_like(self._known_mean[:, :, 0, 0], sign * torch.inf)
            ends.append(torch.cat([known, own], dim=1)[:, self._observed])
        return torch.stack(ends)

    def unroll(
        self,
        observations: Tensor,
        past: Tensor,
        act: Act,
        horizon: int,
        propagation: Propagation = "minimum",
        noise: Tensor | None = None,
        state: Any = None,
    ) -> Iterator[RolloutStep]:
        """Let a policy act for ``horizon`` steps, one after the other.

        Everything is differentiable with respect to the parameters of ``act``. Where gradients are
        switched off, the frames of a trajectory are written into one table, newest first, and its
        histories are windows of that table.

        Args:
            observations: ``[L, B, H * F]`` what policies see at the start, scaled, newest frame
                first; see :meth:`components.data.batches.LaneData.start_states`.
            past: ``[L, B, G, M]`` model frames up to there, newest first, not scaled; if ``state``
                is given, the newest one is enough.
            act: Maps observations ``[L, N, H * F]`` (scaled, newest first) to actions
                ``[L, N, A]``; called once a step.
            horizon: Steps T.
            propagation: Which prediction becomes the next frame; member numbers are ``[T, L, B]``.
            noise: Standard normal ``[T, L, D, B]``: draw the next frame from the chosen member's
                Gaussian instead of taking its mean.
            state: What the model's ``begin`` returned for this past; None: it is computed.

        Yields:
            The T steps.
        """
        copies = self.model.members if propagation == "isolated" else 1
        past = past[:, None].expand(-1, copies, -1, -1, -1)
        observation = observations[:, None].expand(-1, copies, -1, -1)
        if state is None:
            state = self.model.begin(past)
        width = self._scaling.mean.shape[-1]
        table = None if torch.is_grad_enabled() else _with_room(observation, horizon * width)
        mean, scale = _wide(self._scaling.mean), _wide(self._scaling.scale)
        # Features come before trajectories, so that element-wise work runs over long rows.
        newest = past[:, :, :, 0].permute(0, 3, 1, 2)  # [L, M, S, B]
        constant, moved, own = newest.split(self._parts, dim=1)
        own = (own - self._learned_mean) / self._learned_scale
        for step in range(horizon):
            seen = observation.flatten(1, 2)
            action = act(seen)
            by_feature = action.transpose(1, 2).contiguous().view(*moved.shape)
            moved = torch.addcmul(by_feature * self._scale, moved, self._keep)
            moved = moved.clamp(self._dynamics.low, self._dynamics.high)
            known = torch.cat([constant, moved], dim=1)
            scaled = (known - self._known_mean) / self._known_scale
            prediction, state = self.model.predict(
                state, observation, scaled.permute(0, 2, 3, 1), own
            )
            drawn = self._choose(prediction, propagation, step, noise)
            own = drawn.clamp(self._low, self._high)
            raw = own * self._learned_scale + self._learned_mean
            shown = torch.cat([known, raw], dim=1)[:, self._observed]
            frame = ((shown - mean) / scale).permute(0, 2, 3, 1)
            rewards = self._rewards(own).flatten(1)
            yield RolloutStep(seen, action, rewards, frame.flatten(1, 2), prediction, drawn)
            if table is None:
                observation = torch.cat([frame, observation[..., :-width]], dim=-1)
            else:
                start = (horizon - 1 - step) * width
                table[..., start : start + width] = frame
                observation = table[..., start : start + observation.shape[-1]]

    def _rewards(self, targets: Tensor) -> Tensor:
        """Rewards ``[L, S, B]`` of normalised ``targets [L, D, S, B]``."""
        weighted = (targets * _wide(self._reward_weight)).sum(dim=1)
        return weighted + self._reward_offset[:, None, None]

    def _choose(
        self, prediction: Prediction, propagation: Propagation, step: int, noise: Tensor | None
    ) -> Tensor:
        """Normalised targets ``[L, D, S, B]`` of the next frame, not clipped."""
        values = prediction.values
        if propagation == "mean":
            return values.clamp(self._low, self._high).mean(dim=2, keepdim=True)
        chosen: Tensor | None = None
        if isinstance(propagation, Tensor):
            chosen = propagation[step][:, None]
        elif propagation == "minimum":
            clipped = values.detach().clamp(self._low, self._high)
            # The first of equal ones; on a CPU many times as fast as argmin.
            chosen = self._rewards(clipped).min(dim=1, keepdim=True).indices
        if chosen is not None:
            values = _pick(values, chosen)
        if noise is not None and prediction.spread is not None:
            spread = prediction.spread if chosen is None else _pick(prediction.spread, chosen)
            values = values + spread * self._target_scale * noise[step][:, :, None]
        return values


def discounted_sum(rewards: list[Tensor], discount: float) -> Tensor:
    """Returns of trajectories from their rewards step by step: ``T x [...] -> [...]``."""
    powers = discount ** torch.arange(len(rewards), device=rewards[0].device)
    return (torch.stack(rewards, dim=-1) * powers).sum(dim=-1)


def _wide(per_target: Tensor) -> Tensor:
    """``[L, D]`` as a factor of ``[L, D, K, B]``."""
    return per_target[:, :, None, None]


def _pick(values: Tensor, member: Tensor) -> Tensor:
    """Of ``values [L, D, K, B]`` those of ``member [L, 1, B]``: ``[L, D, 1, B]``."""
    return values.gather(2, member[:, None].expand(-1, values.shape[1], -1, -1))


def _with_room(observation: Tensor, before: int) -> Tensor:
    """A table ``[..., before + O]`` that ends with the observation ``[..., O]``."""
    table = observation.new_empty(*observation.shape[:-1], before + observation.shape[-1])
    table[..., before:] = observation
    return table
