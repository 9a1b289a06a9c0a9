"""Tables of frames in which every history is contiguous in memory.

Rows are ordered newest first, so the frames of a history lie one after the other. A batch of
histories is one strided gather, and stacked histories, up to thirty times as large, are never
stored. Logs are laid out once, for scaled and raw frames alike; virtual trajectories are laid out
as they are made.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from components.data.dataset import OfflineDataset
from components.data.history import newest_first

__all__ = ["FrameTable", "LogLayout"]


class FrameTable:
    """Rows of frames, newest first.

    Args:
        rows: ``[R, F]``, contiguous.
    """

    def __init__(self, rows: Tensor) -> None:
        self._rows = rows

    def windows(self, newest: Tensor, length: int) -> Tensor:
        """Histories: the rows ``newest [...]`` and the ``length - 1`` rows after each.

        Returns:
            ``[..., length * F]``, flattened frame by frame.
        """
        rows, width = self._rows.shape
        windows = self._rows.as_strided((rows - length + 1, length * width), (width, 1))
        return windows.index_select(0, newest.flatten()).view(*newest.shape, -1)


class LogLayout:
    """The order of several logs' frames in tables that share it.

    The first frame of an episode is repeated after it, for histories that begin before the episode.

    Args:
        logs: The logs; transitions are numbered through all of them.
        length: Frames of the longest history wanted.
        device: Device of the tables.
    """

    def __init__(self, logs: Sequence[OfflineDataset], length: int, device: torch.device) -> None:
        self._device, self._orders = device, []
        newest, offset = [], 0
        for log in logs:
            order, place = newest_first(log.episode_starts, length)
            self._orders.append(torch.from_numpy(order))
            newest.append(torch.from_numpy(place[log.frame_rows()] + offset))
            offset += len(order)
        self.newest = torch.cat(newest).to(device)  # [N] row of every transition's newest frame

    def table(self, frames: Sequence[Tensor]) -> FrameTable:
        """Table of features of the logs' frames, given as ``[N + E, F]`` per log."""
        laid = [own[order] for own, order in zip(frames, self._orders, strict=True)]
        return FrameTable(torch.cat(laid).to(self._device))
