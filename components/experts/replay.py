"""Replay memory of L lanes: rows on the device, and the same rows in one file per lane.

A row is (observation, action, reward, continues, next observation) in float32, so that drawing a
batch is one gather. Every row is written to its file at once and never changed, so a checkpoint
only has to store the number of rows and a digest of them. Rows that a killed run wrote after its
last checkpoint are overwritten by the run that continues from it, with the same values.
"""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.core.integrity import DamagedFileError
from components.data.batches import Batch
from components.data.sources.robot_collection import Episode

__all__ = ["Replay", "replayed_episodes"]

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

    Attributes:
        filled: Transitions per lane so far, float64 on the device, where a CUDA graph reads it.
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
        self._hashes = [hashlib.sha256() for _ in files]
        self._count = 0
        self.filled = torch.zeros((), dtype=torch.float64, device=device)

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
        for file, written, row in zip(self._files, self._hashes, rows, strict=False):
            file.write(row.tobytes())
            written.update(row.tobytes())
            file.flush()  # a killed process loses what it has not handed to the operating system
        self._rows[:, self._count] = torch.from_numpy(rows)
        self._count += 1
        self.filled.fill_(self._count)

    def digests(self) -> Tensor:
        """SHA-256 of every lane's transitions so far, ``[L, 32]``; these are then on the disk."""
        for file in self._files:
            os.fsync(file.fileno())
        found = [list(written.digest()) for written in self._hashes]
        return torch.tensor(found or [[0] * 32] * len(self._rows), dtype=torch.uint8)

    def restore(self, count: int, digests: Tensor) -> None:
        """Restore the first transitions from the files.

        Args:
            count: Transitions per lane.
            digests: What :meth:`digests` returned when there were so many.

        Raises:
            DamagedFileError: A file holds fewer, or others.
        """
        for lane, file in enumerate(self._files):
            file.seek(0)
            stored = np.fromfile(file, np.float32, count * self._width)
            self._hashes[lane] = hashlib.sha256(stored.tobytes())
            short = stored.size < count * self._width
            if short or list(self._hashes[lane].digest()) != digests[lane].tolist():
                what = "fewer transitions than" if short else "other transitions than those that"
                raise DamagedFileError(
                    f"{file.name} holds {what} its checkpoint counts",
                    Path(file.name),
                    "delete its folder to train from the beginning",
                )
            rows = torch.from_numpy(stored.reshape(count, self._width))
            self._rows[lane, :count] = rows
            file.seek(stored.nbytes)
        self._count = count
        self.filled.fill_(count)

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


def replayed_episodes(
    rows: npt.NDArray[np.float32], observations: int, actions: int, horizon: int
) -> list[Episode]:
    """The episodes that a replay memory's rows are made of.

    An episode ends with a fall, at its time limit, or with the last row.

    Args:
        rows: ``[N, O + A + 1 + 1 + O]`` of a lane, as :class:`Replay` writes them.
        observations: Width O.
        actions: Width A.
        horizon: Time limit of an episode, in steps.
    """
    cuts = np.cumsum([observations, actions, 1, 1])
    seen, taken, rewards, continues, following = np.split(rows, cuts, axis=1)
    episodes, begin = [], 0
    for row in range(len(rows)):
        fallen = continues[row, 0] == 0.0
        if fallen or row + 1 - begin == horizon or row + 1 == len(rows):
            own = slice(begin, row + 1)
            frames = np.concatenate([seen[own], following[row : row + 1]])
            episodes.append(Episode(frames, taken[own], rewards[own, 0], bool(fallen)))
            begin = row + 1
    return episodes
