"""Affine scaling of features, fitted to data and stored with the networks that read scaled data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

__all__ = ["Normaliser"]


@dataclass(frozen=True)
class Normaliser:
    """``(x - mean) / scale`` per feature.

    Attributes:
        mean: ``[..., D]`` float32.
        scale: ``[..., D]`` float32, positive.
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def fit(cls, values: npt.NDArray[np.floating], epsilon: float = 0.0) -> "Normaliser":
        """Mean and standard deviation of the rows of ``values [N, D]``.

        Args:
            values: Data; statistics are accumulated in double precision.
            epsilon: Added to every deviation (TD3+BC uses 1e-3). A feature that never changes,
                such as a fixed setpoint, gets deviation 1, so that it scales to exactly 0.
        """
        mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
        deviation = values.std(axis=0, dtype=np.float64)
        constant = np.ptp(values, axis=0) == 0
        deviation = np.where(constant, 1.0, deviation + epsilon)
        return cls(torch.from_numpy(mean), torch.from_numpy(deviation.astype(np.float32)))

    @classmethod
    def stack(cls, parts: Sequence["Normaliser"]) -> "Normaliser":
        """One normaliser per lane: ``[L, D]``."""
        return cls(torch.stack([p.mean for p in parts]), torch.stack([p.scale for p in parts]))

    def to(self, device: torch.device) -> "Normaliser":
        """The same on another device."""
        return Normaliser(self.mean.to(device), self.scale.to(device))

    def apply(self, x: Tensor) -> Tensor:
        """Scale ``x [..., D]``."""
        return (x - self.mean) / self.scale

    def invert(self, z: Tensor) -> Tensor:
        """Undo :meth:`apply`."""
        return z * self.scale + self.mean
