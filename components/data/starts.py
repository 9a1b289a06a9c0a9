"""Where virtual trajectories may start in a log."""

import numpy as np
import numpy.typing as npt

from components.data.dataset import OfflineDataset

__all__ = ["start_rows"]


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
