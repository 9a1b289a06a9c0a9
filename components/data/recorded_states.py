"""What a log gives to a policy that leaves this project: the plant behind it, and states to check.

See :mod:`components.policies.export`.
"""

from typing import Final

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.policies.portable import Plant
from components.policies.portable_check import States

__all__ = ["plant_of", "recorded_states"]

_NUMBER: Final = 1000


def plant_of(card: DatasetCard) -> Plant:
    """The machine that a log was recorded on."""
    return Plant(
        actions=card.action_features,
        bounds=card.action_bounds,
        sampling=card.sampling,
        log_digest=card.digest,
    )


def recorded_states(log: OfflineDataset, history: int) -> States:
    """A thousand states, evenly over a log; of a shorter one, all.

    Args:
        log: The log.
        history: Frames that the policy sees.
    """
    return States(log.spread_histories(_NUMBER, history), f"recorded, evenly over {log.card.name}")
