"""Sizes of a dataset, as far as they decide how long learning from it takes."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Final

__all__ = ["DataSizes", "relative_work", "weights"]

_PRODUCTS: Final = 0.75  # share of matrix products in the time of an update


@dataclass(frozen=True)
class DataSizes:
    """Widths and length of a dataset; the defaults are those of the Industrial Benchmark's.

    Attributes:
        history: Frames in an observation.
        frame: Values of a frame.
        action: Values of an action.
        transitions: Of all episodes together.
    """

    history: int = 30
    frame: int = 6
    action: int = 3
    transitions: int = 100_000

    @property
    def observation(self) -> int:
        """Values of an observation."""
        return self.history * self.frame


def weights(config: Any, sizes: DataSizes) -> int:
    """Weights of one network of each kind, which read an observation and lead to an action.

    The multiplications of a pass are proportional to them, whatever the networks really read and
    how many there are.

    Args:
        config: A configuration; the widths of its networks are its fields whose names end in
            ``hidden``.
        sizes: Of the dataset.
    """
    found = 0
    for item in fields(config):
        hidden = getattr(config, item.name)
        if item.name.endswith("hidden") and isinstance(hidden, Sequence):
            found += sum(a * b for a, b in pairwise((sizes.observation, *hidden, sizes.action)))
    return found


def relative_work(config: Any, sizes: DataSizes) -> float:
    """Work of an update relative to that with the default networks on the Industrial Benchmark.

    Three quarters grow with the weights: so much of their time TD3+BC and BCQ spend in matrix
    products on a processor. It is 1 for a configuration without networks of its own.
    """
    usual = weights(type(config)(), DataSizes())
    return 1.0 - _PRODUCTS + _PRODUCTS * weights(config, sizes) / usual if usual else 1.0
