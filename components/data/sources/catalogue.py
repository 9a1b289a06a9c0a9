"""All datasets by name: sixteen of the Industrial Benchmark, three of robots."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Protocol

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import INDUSTRIAL_DATASETS, IndustrialSpec
from components.data.sources.robots import ROBOT_DATASETS, RobotSpec

__all__ = ["DATASETS", "DatasetSpec", "generate", "spec_kind"]


class DatasetSpec(Protocol):
    """What a dataset is made of; a frozen dataclass, so that its fields identify it."""

    @property
    def name(self) -> str:
        """Of the dataset."""

    @property
    def discount(self) -> float:
        """Of the returns on the card."""

    @property
    def environment(self) -> str:
        """Gymnasium id of the system it is logged on, and that judges what is learned from it."""

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """The system's parameters."""

    @property
    def history(self) -> int:
        """Frames in an observation."""

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of stored things that it is made with; they identify it beside its fields."""

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset; the same bytes for the same specification, ingredients and seed."""


DATASETS: Final[Mapping[str, DatasetSpec]] = MappingProxyType(
    {**INDUSTRIAL_DATASETS, **ROBOT_DATASETS}
)
"""The nineteen datasets of the thesis's tables."""


def spec_kind(fields: Mapping[str, Any]) -> type[IndustrialSpec] | type[RobotSpec]:
    """The class that plain fields, such as those of a configuration file, describe."""
    return RobotSpec if "robot" in fields else IndustrialSpec


def generate(spec: DatasetSpec, seed: int, threads: int = 1) -> OfflineDataset:
    """Make a dataset; the same bytes for the same specification, ingredients and seed.

    Args:
        spec: what to make, from `DATASETS` or a variation of it.
        seed: a whole number from 0.
        threads: that may be used; the bytes do not depend on them.

    Raises:
        FileNotFoundError: an ingredient is missing.
        ValueError: a negative seed, or a damaged ingredient.
    """
    if seed < 0:
        raise ValueError(f"seed is {seed}; give a whole number from 0.")
    return spec.generate(seed, threads)
