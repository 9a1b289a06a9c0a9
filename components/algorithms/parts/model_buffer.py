"""Virtual transitions in a ring, as short trajectories that begin at recorded states.

A trajectory of T steps is kept as the logged row it began at and its T new frames, actions and
rewards. Its observations are gathered when a batch is drawn: the new frames, newest first, are
joined with the recorded history of the start, so that every observation is contiguous in memory.
Stacked histories, thirty times as large, are never stored.

A trajectory may end before its T steps are over. Steps after its end are no transitions: they are
not counted, so that all others are drawn equally often.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from components.data.batches import Batch, LaneData
from components.data.frame_table import FrameTable

__all__ = ["ModelBuffer"]


class ModelBuffer(nn.Module):
    """Rings of L lanes; a module, so that its contents are part of the learner's state.

    Args:
        data: The lanes' datasets, in which trajectories begin.
        capacity: C, trajectories a lane.
        length: T, steps of each.
    """

    start: Tensor  # [L, C] logged row
    frames: Tensor  # [L, C, T, F] scaled, newest first: step t stands at T - 1 - t
    actions: Tensor  # [L, C, T, A]
    rewards: Tensor  # [L, C, T]
    ended: Tensor  # [L, C] step after which a state is terminal, or T if none is
    before: Tensor  # [L, C + 1] transitions before each place, and in all

    def __init__(self, data: LaneData, capacity: int, length: int) -> None:
        super().__init__()
        self._data, self._length = data, length
        shape, device = (data.lanes, capacity, length), data.device
        self.register_buffer("start", torch.zeros(shape[:2], dtype=torch.int64, device=device))
        self.register_buffer("frames", torch.zeros((*shape, data.frame_width), device=device))
        self.register_buffer("actions", torch.zeros((*shape, data.action_width), device=device))
        self.register_buffer("rewards", torch.zeros(shape, device=device))
        never = torch.full(shape[:2], length, dtype=torch.int16, device=device)
        self.register_buffer("ended", never)
        # It follows from the above, so it is not part of the state.
        counts = torch.zeros((data.lanes, capacity + 1), dtype=torch.int32, device=device)
        self.register_buffer("before", counts, persistent=False)
        self._count()

    def write(
        self,
        place: int,
        start: Tensor,
        frames: Sequence[Tensor],
        actions: Sequence[Tensor],
        rewards: Sequence[Tensor],
        ended: Tensor | None = None,
    ) -> None:
        """Put N trajectories at ``place`` and after it.

        Args:
            place: From 0; the N trajectories must fit between it and the ring's end.
            start: ``[L, N]`` rows they began at.
            frames: T frames ``[L, N, F]`` after each action, oldest first.
            actions: T actions ``[L, N, A]``.
            rewards: T rewards ``[L, N]``.
            ended: ``[L, N]`` first step after which the state is terminal, or T; None: no
                trajectory has ended.
        """
        places = slice(place, place + start.shape[1])
        self.start[:, places] = start
        self.frames[:, places] = torch.stack([*reversed(frames)], dim=2)
        self.actions[:, places] = torch.stack([*actions], dim=2)
        self.rewards[:, places] = torch.stack([*rewards], dim=2)
        self.ended[:, places] = self._length if ended is None else ended.to(self.ended.dtype)
        self._count()

    def _count(self) -> None:
        steps = self.ended.clamp(max=self._length - 1) + 1
        self.before[:, 1:] = steps.cumsum(dim=1)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Restore the contents, and count them."""
        keys = super().load_state_dict(state_dict, strict, assign)
        self._count()
        return keys

    def count(self, places: int) -> Tensor:
        """Transitions of the trajectories at the first places, ``[L, 1]``."""
        return self.before[:, places : places + 1]

    def batch(self, index: Tensor) -> Batch:
        """Transitions ``index [L, B]``, counted trajectory by trajectory, step by step."""
        lane = torch.arange(len(index), device=index.device)[:, None]
        number = index.to(self.before.dtype).contiguous()
        place = torch.searchsorted(self.before, number, right=True) - 1
        step = index - self.before[lane, place]
        ended = self.ended[lane, place]
        recorded = self._data.observations(self.start[lane, place])  # [L, B, H * F]
        whole = torch.cat([self.frames[lane, place].flatten(2), recorded], dim=-1)
        width, seen = self._data.frame_width, self._data.observation_width
        count = whole.shape[-1] // width  # frames of a transition's row in ``whole``
        newest = count * torch.arange(index.numel(), device=index.device).view(index.shape)
        newest = newest + (self._length - 1 - step)
        # One frame more than a history, for the next observation's newest one.
        window = FrameTable(whole.view(-1, width)).windows(newest, self._data.history + 1)
        rewards = self.rewards[lane, place, step]
        return Batch(
            observations=window[:, :, width:],
            actions=self.actions[lane, place, step],
            rewards=rewards,
            next_observations=window[:, :, :seen],
            continues=(step != ended).to(rewards.dtype),
        )
