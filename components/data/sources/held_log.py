"""Logs that a program holds in memory, in the place of stored ones."""

from dataclasses import dataclass, field

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.data.sources.stored_log import StoredLog

__all__ = ["HeldLog"]


@dataclass(frozen=True)
class HeldLog(StoredLog):
    """A log in memory and the name of it.

    Attributes:
        held: The log.
    """

    held: OfflineDataset = field(compare=False, repr=False)

    @classmethod
    def of(cls, log: OfflineDataset) -> "HeldLog":
        """A log under its own name."""
        return cls(log.card.name, "", log)

    @property
    def card(self) -> DatasetCard:
        """The card of the log."""
        return self.held.card

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """The log itself; the seed is not used."""
        return self.held
