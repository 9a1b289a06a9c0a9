"""Datasets as lane-first tensors on a device: every lane draws from its own dataset.

Lanes of the same dataset share its frames. Frames are normalised once, when they are loaded, and
laid out newest first, so that a history of H frames is one run of memory in the narrow frame table;
the wide table of stacked histories never exists.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.history import newest_first

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
        scaling: One for the frames of all lanes, instead of their datasets' own moments.

    Raises:
        ValueError: If the lanes' datasets differ in frame, action or history width.
    """

    def __init__(
        self,
        datasets: Sequence[OfflineDataset],
        device: torch.device,
        epsilon: float = 0.0,
        scaling: Normaliser | None = None,
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
        scalers = {d.card.digest: scaling or Normaliser.fit(d.frames, epsilon) for d in distinct}
        self.frame_scaling = Normaliser.stack([scalers[d.card.digest] for d in datasets]).to(device)
        self.counts = [d.transitions for d in datasets]  # transitions per lane

        self._distinct = distinct
        scaled = [
            scalers[d.card.digest].apply(torch.from_numpy(np.array(d.frames))) for d in distinct
        ]
        # One frame more than a history, for the next observation's newest one.
        self._frames, self._newest = self._laid_out(scaled, self.history + 1)
        self._model_frames: dict[int, tuple[Tensor, Tensor]] = {}
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

    def row_draw(self, batch: int) -> Callable[..., npt.NDArray[np.int64]]:
        """Drawing rule of uniform transitions, for a stream of batches ``[L, batch]``."""
        return lambda g, lane, steps: g.integers(self.counts[lane], size=(steps, batch))

    def batch(self, index: Tensor) -> Batch:
        """Gather transitions ``index [L, B]``, counted within each lane's dataset."""
        flat = index + self._base
        window = _runs(self._frames, self._newest[flat] - 1, self.history + 1)
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
        flat = index + self._base
        return _runs(self._frames, self._newest[flat], self.history)

    def actions(self, index: Tensor) -> Tensor:
        """Logged actions ``[L, B, A]`` of transitions ``index [L, B]``."""
        return self._actions[index + self._base]

    def denormalise_history(self, observations: Tensor) -> Tensor:
        """Raw frames ``[L, B, H, F]`` of normalised histories ``[L, B, O]``."""
        frames = observations.view(*observations.shape[:-1], self.history, self.frame_width)
        scaling = self.frame_scaling
        return frames * scaling.scale[:, None, None] + scaling.mean[:, None, None]

    def recorded(self, index: Tensor, frames: int) -> tuple[Tensor, Tensor]:
        """What policies and models know of the past of transitions ``index [L, B]``.

        Args:
            index: Counted within each lane's dataset.
            frames: G, machine frames that a model begins with.

        Returns:
            Raw histories ``[L, B, H, F]`` as policies see them, and raw machine frames, newest
            first: ``[L, B, G, M]``, where the first one of an episode is repeated before it; or the
            histories themselves, where policies see whole machine frames.
        """
        history = self.denormalise_history(self.observations(index))
        rule = DynamicsSpecification.of_card(self.datasets[0].card)
        if not rule.hides:
            return history, history
        if frames not in self._model_frames:
            tables = [torch.from_numpy(model_frames(d, rule)) for d in self._distinct]
            self._model_frames[frames] = self._laid_out(tables, frames)
        table, newest = self._model_frames[frames]
        found = _runs(table, newest[index + self._base], frames)
        return history, found.view(*index.shape, frames, -1)

    def _laid_out(self, tables: Sequence[Tensor], length: int) -> tuple[Tensor, Tensor]:
        """Frames ``[N + E, F]`` of the distinct datasets, so that histories are runs of rows.

        Returns:
            One table of all of them, and the row of every transition's newest frame.
        """
        laid, newest, offset = [], [], 0
        for data, frames in zip(self._distinct, tables, strict=True):
            order, place = newest_first(data.episode_starts, length)
            laid.append(frames[torch.from_numpy(order)])
            newest.append(torch.from_numpy(place[data.frame_rows()] + offset))
            offset += len(order)
        return torch.cat(laid).to(self.device), torch.cat(newest).to(self.device)


def _runs(table: Tensor, newest: Tensor, length: int) -> Tensor:
    """Histories ``[L, B, length * F]`` that begin with the table's rows ``newest [L, B]``."""
    rows, width = table.shape
    windows = table.as_strided((rows - length + 1, length * width), (width, 1))
    return windows.index_select(0, newest.flatten()).view(*newest.shape, -1)
