"""Replay memory of L lanes: rows on the device, and the same rows in one file per lane.

A row is (observation, action, reward, continues, next observation) in float32, so that drawing a
batch is one gather. Every row is written to its file at once and never changed, so a checkpoint
only has to store the number of rows. Rows that a killed run wrote after its last checkpoint are
overwritten by the run that continues from it, with the same values.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.data.batches import Batch

__all__ = ["Replay"]

Array = npt.NDArray[np.floating]


class Replay:
    """Transitions of L lanes in the order in which they happened.

    Args:
        lanes: L.
        capacity: Transitions per lane.
        observations: Width O.
        actions: Width A.
        device: Where batches are drawn.
        files: One per lane, made if missing; without files transitions are in memory only.
    """

    def __init__(
        self,
        lanes: int,
        capacity: int,
        observations: int,
        actions: int,
        device: torch.device,
        files: Sequence[Path] = (),
    ) -> None:
        self._widths = [observations, actions, 1, 1, observations]
        self._width = sum(self._widths)
        self._rows = torch.empty((lanes, capacity, self._width), device=device)
        self._base = capacity * torch.arange(lanes, device=device)[:, None]
        self._files = [path.open("r+b" if path.exists() else "w+b") for path in files]
        self._count = 0

    @property
    def count(self) -> int:
        """Transitions per lane so far."""
        return self._count

    def append(
        self,
        observations: Array,
        actions: Array,
        rewards: Array,
        terminated: npt.NDArray[np.bool_],
        following: Array,
    ) -> None:
        """Append one transition per lane.

        Args:
            observations: ``[L, O]`` before the action.
            actions: ``[L, A]``.
            rewards: ``[L]``.
            terminated: ``[L]`` whether the next state is terminal; after a time-out it is not.
            following: ``[L, O]`` after the action.
        """
        continues = ~terminated[:, None]
        parts = [observations, actions, rewards[:, None], continues, following]
        rows = np.concatenate(parts, axis=1, dtype=np.float32)
        for file, row in zip(self._files, rows, strict=False):
            file.write(row.tobytes())
            file.flush()  # a killed process loses what it has not handed to the operating system
        self._rows[:, self._count] = torch.from_numpy(rows)
        self._count += 1

    def restore(self, count: int) -> None:
        """Restore the first transitions from the files.

        Args:
            count: Transitions per lane.

        Raises:
            ValueError: A file holds fewer.
        """
        for lane, file in enumerate(self._files):
            file.seek(0)
            stored = np.fromfile(file, np.float32, count * self._width)
            if stored.size < count * self._width:
                raise ValueError(
                    f"{file.name} holds fewer transitions than its checkpoint counts; delete its "
                    "folder to train from the beginning."
                )
            rows = torch.from_numpy(stored.reshape(count, self._width))
            self._rows[lane, :count] = rows
            file.seek(stored.nbytes)
        self._count = count

    def actions(self, index: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Actions ``[L, A]`` of one transition per lane, ``index [L]``."""
        lanes = torch.arange(len(self._rows))
        rows = self._rows[lanes, torch.from_numpy(index)]
        taken: npt.NDArray[np.float32] = rows.split(self._widths, dim=-1)[1].cpu().numpy()
        return taken

    def batch(self, index: Tensor) -> Batch:
        """Gather transitions ``index [L, B]``, counted within each lane."""
        flat = (index + self._base).flatten()
        rows = self._rows.view(-1, self._width).index_select(0, flat).view(*index.shape, -1)
        observations, actions, rewards, continues, following = rows.split(self._widths, dim=-1)
        return Batch(
            observations=observations,
            actions=actions,
            rewards=rewards.squeeze(-1),
            next_observations=following,
            continues=continues.squeeze(-1),
        )
