"""Unroll policies through a learned ensemble: the one place where virtual trajectories are made.

Every lane has its own ensemble of K recurrent pairs, its own policy and B trajectories. At each
step the policy acts, the steerings follow exactly (clipped integration, differentiable), every
member advances its own hidden state, and the prediction of one member becomes the next frame. With
``propagation="minimum"`` that is, per trajectory and step, the member that predicts the lowest
reward (thesis 6.4). Predictions are clipped to the range of the training data, and the clipped
value is fed back.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from components.data.dataset import DatasetCard
from components.data.normaliser import Normaliser
from components.models.recurrent_ensemble import INPUTS, TARGETS, RecurrentEnsemble
from components.networks.recurrent import fast_tanh, unroll_cells

__all__ = ["MachineRule", "VirtualMachine"]

Act = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class MachineRule:
    """What is known of the machine without learning, from the dataset's card.

    Attributes:
        action_scale: Change of (velocity, gain, shift) per unit of action.
        low: Smallest steering.
        high: Largest steering.
        reward: Weights of (fatigue, consumption) in the reward of a frame.
    """

    action_scale: tuple[float, ...]
    low: float
    high: float
    reward: tuple[float, ...]

    @classmethod
    def of_card(cls, card: DatasetCard) -> "MachineRule":
        """Read the rule off a dataset's card.

        Raises:
            ValueError: If the card does not tell how actions move the steerings.
        """
        machine = card.machine
        try:
            return cls(
                action_scale=tuple(machine["action_scale"]),
                low=machine["steering_low"],
                high=machine["steering_high"],
                reward=tuple(machine["reward"][name] for name in TARGETS),
            )
        except KeyError as error:
            raise ValueError(
                f"The card of {card.name} lacks {error} in its machine section, which virtual "
                "trajectories need."
            ) from error


class VirtualMachine:
    """The learned machine of L lanes.

    Args:
        ensembles: One per lane, of equal shapes.
        rule: How actions move the steerings, and the reward.
        scaling: Scaling of the frames that policies see, ``[L, F]``.
        device: Where to compute.
    """

    def __init__(
        self,
        ensembles: Sequence[RecurrentEnsemble],
        rule: MachineRule,
        scaling: Normaliser,
        device: torch.device,
    ) -> None:
        self._lanes, self._members = len(ensembles), ensembles[0].members
        self._weight = torch.cat([e.weight for e in ensembles]).to(device)  # [L * 2K, H, H + 6]
        self._readout = torch.cat([e.readout for e in ensembles]).to(device)
        self._frames = Normaliser.stack([e.frames for e in ensembles]).to(device)
        self._low = torch.stack([e.low for e in ensembles]).to(device)[:, :, None, None]
        self._high = torch.stack([e.high for e in ensembles]).to(device)[:, :, None, None]
        self._scaling = scaling.to(device)
        self._rule = rule
        self._action_scale = torch.tensor(rule.action_scale, device=device)
        reward = torch.tensor(rule.reward, device=device)
        outputs = slice(len(INPUTS), len(INPUTS) + len(TARGETS))
        # Reward of a normalised prediction: weights times scale, and the part of the means.
        self._reward_weight = (reward * self._frames.scale[:, outputs])[:, :, None]
        self._reward_offset = (reward * self._frames.mean[:, outputs]).sum(dim=1)[:, None]
        self._output_scale = self._frames.scale[:, outputs, None]
        self._output_mean = self._frames.mean[:, outputs, None]
        # The fatigue networks (first half) read their previous value, the others read zero.
        self._feeds_back = torch.tensor([1.0, 0.0], device=device)[None, :, None, None, None]

    def unroll(self, history: Tensor, act: Act, horizon: int) -> Tensor:
        """Let a policy act for ``horizon`` steps.

        Args:
            history: ``[L, B, H, F]`` raw frames, newest first; the hidden state is built on them.
            act: Maps observations ``[L, B, H * F]`` (scaled, newest first) to actions
                ``[L, B, A]``; called once a step.
            horizon: Steps T.

        Returns:
            Rewards ``[T, L, B]``, differentiable with respect to whatever ``act`` depends on.
        """
        scaling = self._scaling
        frames = (history - scaling.mean[:, None, None]) / scaling.scale[:, None, None]
        observation = frames.flatten(start_dim=2)
        width = history.shape[-1]
        hidden = self._warm_up(history)
        setpoint, steering = history[:, :, 0, :1], history[:, :, 0, 1 : len(INPUTS)]
        outputs = history[:, :, 0, len(INPUTS) :].transpose(1, 2)  # [L, 2, B] raw
        own = (outputs - self._output_mean) / self._output_scale
        rewards = []
        for _ in range(horizon):
            action = act(observation)
            steering = (steering + action * self._action_scale).clamp(
                self._rule.low, self._rule.high
            )
            inputs = torch.cat([setpoint, steering], dim=-1)
            hidden, own, reward = self._advance(hidden, inputs, own)
            rewards.append(reward)
            raw = (own * self._output_scale + self._output_mean).transpose(1, 2)
            frame = (torch.cat([inputs, raw], dim=-1) - scaling.mean[:, None]) / scaling.scale[
                :, None
            ]
            observation = torch.cat([frame, observation[:, :, :-width]], dim=-1)
        return torch.stack(rewards)

    @torch.no_grad()
    def _warm_up(self, history: Tensor) -> Tensor:
        """Hidden states ``[L * 2K, H, B]`` after the recorded frames."""
        lanes, batch, length, _ = history.shape
        scaled = (history - self._frames.mean[:, None, None]) / self._frames.scale[:, None, None]
        oldest_first = scaled.flip(2).permute(2, 0, 3, 1)  # [H, L, F, B]
        posterior = oldest_first[1:, :, None, None, : len(INPUTS)]
        previous = oldest_first[:-1, :, len(INPUTS) :, None, None] * self._feeds_back
        shape = (length - 1, lanes, len(TARGETS), self._members)
        inputs = torch.cat(
            [
                posterior.expand(*shape, len(INPUTS), batch),
                previous.expand(*shape, 1, batch),
            ],
            dim=4,
        )
        width = self._weight.shape[1]
        start = history.new_zeros(self._weight.shape[0], width, batch)
        _, hidden = unroll_cells(self._weight, self._readout, start, inputs.flatten(1, 3))
        return hidden

    def _advance(
        self, hidden: Tensor, inputs: Tensor, own: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step of all members.

        Args:
            hidden: ``[L * 2K, H, B]``.
            inputs: ``[L, B, 4]`` raw setpoint and steerings after the action.
            own: ``[L, 2, B]`` normalised fatigue and consumption before the action.

        Returns:
            Next hidden state, next normalised fatigue and consumption, reward ``[L, B]``.
        """
        lanes, members = self._lanes, self._members
        mean, scale = self._frames.mean[:, None, : len(INPUTS)], self._frames.scale[:, None]
        scaled = ((inputs - mean) / scale[..., : len(INPUTS)]).transpose(1, 2)  # [L, 4, B]
        batch = scaled.shape[-1]
        shape = (lanes, len(TARGETS), members)
        fed = (own[:, :, None, None] * self._feeds_back).expand(*shape, 1, batch)
        seen = torch.cat(
            [
                hidden.view(*shape, -1, batch),
                scaled[:, None, None].expand(*shape, len(INPUTS), batch),
                fed,
                torch.ones_like(fed),
            ],
            dim=3,
        ).flatten(0, 2)
        hidden = fast_tanh(torch.bmm(self._weight, seen))
        predicted = torch.baddbmm(self._readout[:, :, -1:], self._readout[:, :, :-1], hidden)
        predicted = predicted.view(*shape, batch).clamp(self._low, self._high)  # [L, 2, K, B]
        reward = (predicted * self._reward_weight[..., None]).sum(dim=1)
        reward = reward + self._reward_offset[:, None]
        lowest = reward.detach().argmin(dim=1, keepdim=True)  # [L, 1, B]
        chosen = predicted.gather(2, lowest[:, None].expand(-1, len(TARGETS), -1, -1))
        return hidden, chosen.squeeze(2), reward.gather(1, lowest).squeeze(1)
