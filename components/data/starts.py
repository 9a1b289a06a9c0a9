"""Where virtual trajectories may start in a log."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.data.batches import LaneData
from components.data.dataset import OfflineDataset

__all__ = ["spread_starts", "start_rows"]


def start_rows(dataset: OfflineDataset, window: int, after: int = 0) -> npt.NDArray[np.int64]:
    """Transitions in whose states virtual trajectories may start, ``[<= E * (window - after)]``.

    Args:
        dataset: The log.
        window: Steps ``after`` ... ``window - 1`` of every episode are taken.
        after: First step taken.

    Raises:
        ValueError: If no episode is longer than ``after``.
    """
    step = np.arange(dataset.transitions) - dataset.episode_starts[dataset.episode_index()]
    found = np.flatnonzero((after <= step) & (step < window))
    if not len(found):
        raise ValueError(
            f"No trajectory of {dataset.card.name} has a step after its first {after}; lower "
            "start_after."
        )
    return found


def spread_starts(data: LaneData, window: int, after: int = 0, count: int = 40) -> Tensor:
    """The same start states whoever asks: ``[L, count]``, evenly spaced over those of each log."""
    chosen = []
    for dataset in data.datasets:
        rows = start_rows(dataset, window, after)
        chosen.append(rows[np.linspace(0, len(rows) - 1, count).round().astype(np.int64)])
    return torch.from_numpy(np.stack(chosen)).to(data.device)
