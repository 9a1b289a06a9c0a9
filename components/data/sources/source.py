"""What a dataset comes from: one kind of source per way of getting a log."""

from collections.abc import Mapping
from typing import Any, Protocol

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog

__all__ = ["DatasetSource", "generate", "source_kind"]


class DatasetSource(Protocol):
    """Where a dataset comes from; a frozen dataclass with the fields of conf/dataset."""

    @property
    def name(self) -> str:
        """Of the dataset."""

    @property
    def identity(self) -> Mapping[str, Any]:
        """The fields that identify the dataset: what :func:`source_kind` makes the same one of."""

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of stored things that it is made with; they identify it beside its fields."""

    @property
    def environment(self) -> str | None:
        """Gymnasium id of the system that judges what is learned from it; None: there is none."""

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """The system's parameters."""

    @property
    def discount(self) -> float:
        """Of the returns on the card."""

    @property
    def history(self) -> int:
        """Frames in an observation."""

    @property
    def steps(self) -> int:
        """Of the longest episode, at most."""

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset; the same bytes for the same fields, ingredients and seed."""


def source_kind(
    fields: Mapping[str, Any],
) -> type[IndustrialSpec] | type[RobotSpec] | type[StoredLog]:
    """The class that plain fields, such as those of a configuration file, describe."""
    if "log" in fields:
        return StoredLog
    return RobotSpec if "robot" in fields else IndustrialSpec


def generate(source: DatasetSource, seed: int, threads: int = 1) -> OfflineDataset:
    """Make a dataset; the same bytes for the same fields, ingredients and seed.

    Args:
        source: what to make.
        seed: a whole number from 0.
        threads: that may be used; the bytes do not depend on them.

    Raises:
        FileNotFoundError: an ingredient is missing.
        ValueError: a negative seed, or a damaged ingredient.
    """
    if seed < 0:
        raise ValueError(f"seed is {seed}; give a whole number from 0.")
    return source.generate(seed, threads)
