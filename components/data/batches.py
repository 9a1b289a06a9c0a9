"""Datasets as lane-first tensors on a device: every lane draws from its own dataset.

Lanes of the same dataset share its frames. Frames are scaled once, when they are loaded, and laid
out in tables from which histories are gathered (:mod:`components.data.frame_table`). Model-based
learners also read unscaled frames; their tables are made on first use.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from components.core.draws import Draw, Integers
from components.core.normaliser import Normaliser
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.frame_table import FrameTable, LogLayout

__all__ = ["Batch", "LaneData"]


@dataclass(frozen=True)
class Batch:
    """Transitions of L lanes.

    Attributes:
        observations: ``[L, B, O]`` normalised history, newest frame first.
        actions: ``[L, B, A]`` in [-1, 1].
        rewards: ``[L, B]``.
        next_observations: ``[L, B, O]``.
        continues: ``[L, B]`` 0 where the next state is terminal, 1 everywhere else: the end of a
            logged trajectory is a time-out and is bootstrapped through.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    continues: Tensor

    def lanes(self, lanes: slice) -> "Batch":
        """Some of the lanes."""
        return Batch(**{f.name: getattr(self, f.name)[lanes] for f in fields(self)})


class LaneData:
    """The datasets of L lanes on one device.

    Args:
        datasets: One dataset per lane; equal digests are stored once.
        device: Where to put the tensors.
        epsilon: Added to the feature deviations, see :meth:`Normaliser.fit`.
        scaling: Makes the scaling of a dataset's frames; by default of the moments of all of them.

    Raises:
        ValueError: If the lanes' datasets differ in frame, action or history width.
    """

    def __init__(
        self,
        datasets: Sequence[OfflineDataset],
        device: torch.device,
        epsilon: float = 0.0,
        scaling: Callable[[OfflineDataset], Normaliser] | None = None,
    ) -> None:
        shapes = {(d.frames.shape[1], d.actions.shape[1], d.card.history) for d in datasets}
        if len(shapes) != 1:
            raise ValueError(
                "Lanes of one stack need equal frame, action and history widths, got "
                f"{sorted(shapes)}."
            )
        ((self.frame_width, self.action_width, self.history),) = shapes
        self.device = device
        self.datasets = list(datasets)
        distinct = list({d.card.digest: d for d in datasets}.values())
        scale = scaling or (lambda d: Normaliser.fit(d.frames, epsilon))
        scalers = {d.card.digest: scale(d) for d in distinct}
        self.frame_scaling = Normaliser.stack([scalers[d.card.digest] for d in datasets]).to(device)
        self.counts = [d.transitions for d in datasets]  # transitions per lane

        self._distinct = distinct
        # One frame more than a history, for the next observation's newest one.
        self._layout = LogLayout(distinct, self.history + 1, device)
        self._scaled = self._layout.table(
            [scalers[d.card.digest].apply(torch.from_numpy(np.array(d.frames))) for d in distinct]
        )
        self._model_tables: dict[int, tuple[LogLayout, FrameTable]] = {}
        actions, rewards, continues = [], [], []
        offsets, transition_offset = {}, 0
        for data in distinct:
            offsets[data.card.digest] = transition_offset
            actions.append(torch.from_numpy(np.array(data.actions)))
            rewards.append(torch.from_numpy(np.array(data.rewards)))
            continues.append(1.0 - torch.from_numpy(np.array(data.terminated, dtype=np.float32)))
            transition_offset += data.transitions
        self._actions, self._rewards = torch.cat(actions).to(device), torch.cat(rewards).to(device)
        self._continues = torch.cat(continues).to(device)
        self._base = torch.tensor([offsets[d.card.digest] for d in datasets], device=device)[
            :, None
        ]

    @property
    def lanes(self) -> int:
        """Number of lanes L."""
        return len(self.counts)

    @property
    def observation_width(self) -> int:
        """Width O of a stacked history."""
        return int(self.history * self.frame_width)

    def row_draw(self, batch: int) -> Draw:
        """Drawing rule of uniform transitions, for a stream of batches ``[L, batch]``."""
        return Integers(self.counts, batch)

    def batch(self, index: Tensor) -> Batch:
        """Gather transitions ``index [L, B]``, counted within each lane's dataset."""
        flat = index + self._base
        window = self._scaled.windows(self._layout.newest[flat] - 1, self.history + 1)
        actions, rewards = self._actions[flat], self._rewards[flat]
        return Batch(
            observations=window[:, :, self.frame_width :],
            actions=actions,
            rewards=rewards,
            next_observations=window[:, :, : self.observation_width],
            continues=self._continues[flat],
        )

    def observations(self, index: Tensor) -> Tensor:
        """Normalised histories ``[L, B, O]`` of transitions ``index [L, B]``."""
        return self._scaled.windows(self._layout.newest[index + self._base], self.history)

    def actions(self, index: Tensor) -> Tensor:
        """Logged actions ``[L, B, A]`` of transitions ``index [L, B]``."""
        return self._actions[index + self._base]

    def raw_histories(self, index: Tensor) -> Tensor:
        """Frames ``[L, B, H, F]`` as logged, of the histories of transitions ``index [L, B]``."""
        found = self._raw.windows(self._layout.newest[index + self._base], self.history)
        return found.view(*index.shape, self.history, -1)

    def start_states(self, index: Tensor, frames: int) -> tuple[Tensor, Tensor]:
        """Observations and model frames up to the states of transitions ``index [L, B]``.

        Args:
            index: Counted within each lane's dataset.
            frames: G, model frames that a transition model reads before its first prediction.

        Returns:
            Observations ``[L, B, O]`` as policies see them; model frames ``[L, B, G, M]``, newest
            first and not scaled, where the first one of an episode is repeated before it. Where
            policies see whole model frames, these are as many as they see, H instead of G.
        """
        if not self._dynamics.hides:
            return self.observations(index), self.raw_histories(index)
        if frames not in self._model_tables:
            self._model_tables[frames] = self._model_table(frames)
        layout, table = self._model_tables[frames]
        found = table.windows(layout.newest[index + self._base], frames)
        return self.observations(index), found.view(*index.shape, frames, -1)

    def _model_table(self, frames: int) -> tuple[LogLayout, FrameTable]:
        """Table of model frames for pasts of ``frames``; short ones use the policies' layout."""
        fits = frames <= self.history + 1
        layout = self._layout if fits else LogLayout(self._distinct, frames, self.device)
        tables = [torch.from_numpy(model_frames(d, self._dynamics)) for d in self._distinct]
        return layout, layout.table(tables)

    @cached_property
    def _raw(self) -> FrameTable:
        """Frames as logged, in the order of the scaled ones; for model-based learners alone."""
        return self._layout.table([torch.from_numpy(np.array(d.frames)) for d in self._distinct])

    @cached_property
    def _dynamics(self) -> DynamicsSpecification:
        return DynamicsSpecification.of_card(self.datasets[0].card)
