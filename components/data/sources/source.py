"""The interface of dataset sources, and the choice among their kinds."""

from collections.abc import Mapping
from typing import Any, Final, Protocol

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog
from components.data.sources.world import WorldSpec

__all__ = ["SOURCE_FIELDS", "DatasetSource", "generate", "source_kind"]


class DatasetSource(Protocol):
    """A source of a dataset: a frozen dataclass with the fields of a file of conf/dataset."""

    @property
    def name(self) -> str:
        """Name of the dataset."""

    @property
    def identity(self) -> Mapping[str, Any]:
        """The fields that identify the dataset; the class of :func:`source_kind` takes them."""

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of stored artifacts that it is made with; they identify it, too."""

    @property
    def environment(self) -> str | None:
        """Gymnasium id of the system on which policies are evaluated; None: there is none."""

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """The system's parameters."""

    @property
    def discount(self) -> float:
        """Gamma of the returns on the card."""

    @property
    def history(self) -> int:
        """Frames in an observation."""

    @property
    def steps(self) -> int:
        """Largest number of steps of an episode."""

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset; the same bytes for the same fields, ingredients and seed."""


_KINDS: Final = {
    "log": StoredLog,
    "robot": RobotSpec,
    "goals": WorldSpec,
    "controller": IndustrialSpec,
}
"""Classes by the field that only their datasets have."""
SOURCE_FIELDS: Final = tuple(_KINDS)
"""A dataset's fields hold one of these, which tells its kind."""


def source_kind(
    fields: Mapping[str, Any],
) -> type[IndustrialSpec] | type[RobotSpec] | type[StoredLog] | type[WorldSpec]:
    """The class that plain fields, such as those of a configuration file, describe."""
    return next((kind for name, kind in _KINDS.items() if name in fields), IndustrialSpec)


def generate(source: DatasetSource, seed: int, threads: int = 1) -> OfflineDataset:
    """Make a dataset; the same bytes for the same fields, ingredients and seed.

    Args:
        source: what to make.
        seed: a whole number from 0.
        threads: number of threads to use; the bytes do not depend on it.

    Raises:
        FileNotFoundError: an ingredient is missing.
        ValueError: a negative seed, or a damaged ingredient.
    """
    if seed < 0:
        raise ValueError(f"seed is {seed}; give a whole number from 0.")
    return source.generate(seed, threads)
