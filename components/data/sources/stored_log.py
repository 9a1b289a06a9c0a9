"""Logs that are stored in a folder already, such as those of a real plant.

The folder is one that `OfflineDataset.write` has filled, with a card as :func:`.assembly.assemble`
makes it. The properties of the dataset are read from that card. Where it names a registered system,
policies learned from the log are evaluated there; a real plant has no simulator.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.environments.systems import SYSTEMS

__all__ = ["StoredLog"]


_NO_SYSTEM: Final = "none"
"""What a card may say of a plant without a simulator, if it says anything."""


@dataclass(frozen=True)
class StoredLog:
    """A stored log and the name under which it is benchmarked.

    Attributes:
        name: of the dataset.
        log: the folder.
    """

    name: str
    log: str

    @property
    def folder(self) -> Path:
        """Where the log lies."""
        return Path(self.log)

    @cached_property
    def card(self) -> DatasetCard:
        """The stored card. It is read on first use, so the folder of an unused log may be missing.

        Raises:
            FileNotFoundError: there is no log.
            ValueError: its card cannot be read, or names a system that is not registered.
        """
        card = self._opened(check=False).card
        if card.environment and card.environment not in (_NO_SYSTEM, *SYSTEMS):
            raise ValueError(
                f"The card in {self.folder} names the system {card.environment!r}; registered are "
                f"{', '.join(SYSTEMS)}. Correct `environment`, or leave it empty where there is "
                "none."
            )
        return card

    def _opened(self, *, check: bool) -> OfflineDataset:
        try:
            return OfflineDataset.open(self.folder, check=check)
        except (FileNotFoundError, ValueError) as error:
            reason = str(error).rstrip(".").replace("generate the dataset again", "store it again")
            raise type(error)(
                f"{reason}, or correct `log` in conf/dataset/{self.name}.yaml."
            ) from error

    @property
    def identity(self) -> Mapping[str, Any]:
        """The name alone: its folder changes nothing, and its content is among the ingredients."""
        return {"name": self.name, "log": ""}

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of the arrays and of the card.

        Raises:
            FileNotFoundError: there is no log.
            ValueError: its card cannot be read.
        """
        card = hashlib.sha256(self.card.to_json().encode()).hexdigest()
        return {"log": self.card.digest, "card": card}

    @property
    def environment(self) -> str | None:
        """Gymnasium id of the system on its card; None where there is none."""
        return self.card.environment if self.card.environment in SYSTEMS else None

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """The system's parameters, as on its card."""
        return self.card.environment_parameters

    @property
    def discount(self) -> float:
        """Of the returns on the card."""
        return self.card.discount

    @property
    def history(self) -> int:
        """Frames in an observation."""
        return self.card.history

    @property
    def steps(self) -> int:
        """Of the longest episode."""
        return self.card.steps

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Open the log under the name it has here and check its bytes; the seed is not used.

        Raises:
            FileNotFoundError: there is no log, or one of its files is missing.
            ValueError: it is damaged.
        """
        stored = self._opened(check=True)
        return replace(stored, card=replace(stored.card, name=self.name))
