"""How well policies do what a log did, which needs no system: errors on logged actions."""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from components.data.dataset import OfflineDataset
from components.data.history import gather_history
from components.policies.policy import Policy

__all__ = ["imitation_errors"]

_AT_ONCE: Final = 4096  # states


def imitation_errors(policy: Policy, dataset: OfflineDataset) -> NDArray[np.float64]:
    """Mean squared distances per action entry to all logged actions.

    Args:
        policy: A stack of S policies; those that take the proximity are asked at 0.
        dataset: The log; one that the policies have not seen.

    Returns:
        ``[S]``.
    """
    newest, first = dataset.frame_rows(), dataset.first_rows()
    total = np.zeros(policy.lanes)
    for begin in range(0, dataset.transitions, _AT_ONCE):
        rows = slice(begin, begin + _AT_ONCE)
        seen = gather_history(dataset.frames, newest[rows], first[rows], policy.card.history)
        histories = torch.from_numpy(seen).view(len(seen), policy.card.history, -1)
        proximity = torch.zeros(policy.lanes, len(seen)) if policy.card.takes_proximity else None
        actions = policy.act(histories.expand(policy.lanes, *histories.shape), proximity).numpy()
        total += np.square(actions - dataset.actions[rows], dtype=np.float64).sum(axis=(1, 2))
    mean: NDArray[np.float64] = total / dataset.actions.size
    return mean
