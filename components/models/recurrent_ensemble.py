"""Recurrent transition ensemble for partly observed machines (thesis 3.3.2, 6.2).

K pairs of tanh RNNs; in each pair one network predicts fatigue and one consumption. The steerings
of the next frame follow from the action exactly (clipped integration), so the networks see the
frame *after* the action: normalised (setpoint, velocity, gain, shift), the fatigue network its own
previous value as well. Each predicts the absolute normalised value of its target in that frame.

The hidden state is built up on recorded frames; after the first predicted step the fatigue network
is fed its own prediction, unclipped (thesis 6.2, eq. 3.41). Because the reading is linear in the
hidden state, feeding it back equals using another recurrent matrix, ``W_h + w_self r``: both
phases are plain scans over known inputs.

How the networks are trained is in :mod:`components.models.recurrent_fit`.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.data.normaliser import Normaliser
from components.models.rollout import INPUTS, TARGETS
from components.networks.checkpoint import load_tensors, save_tensors
from components.networks.recurrent import unroll_cells

__all__ = ["RecurrentEnsemble", "RecurrentEnsembleConfig", "predict_windows"]

FORMAT = "recurrent-ensemble/1"
FILE = "ensemble.safetensors"


@dataclass(frozen=True, kw_only=True)
class RecurrentEnsembleConfig:
    """How the ensemble is built and trained."""

    members: int = 4  # K pairs of networks
    hidden: int = 30  # units of each tanh cell
    warm_up: int = 30  # G, recorded steps that build up the hidden state
    horizon: int = 50  # F, predicted steps that enter the loss
    batch: int = 256  # windows per update and network
    updates: int = 3000  # budget; training may stop earlier
    learning_rate: float = 5e-3  # peak of the one-cycle schedule
    warm_fraction: float = 0.1  # part of the budget over which the rate rises
    weight_decay: float = 1e-3  # L2 term inside Adam
    clip_norm: float = 1.0  # largest gradient norm per network
    holdout: float = 0.1  # last fraction of the trajectories, never trained on
    validate_every: int = 150  # updates
    patience: int = 10  # validations without improvement of any network before stopping

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the field and its range.
        """
        for name in ("members", "hidden", "warm_up", "horizon", "batch", "updates",
                     "validate_every", "patience"):  # fmt: skip
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if self.learning_rate <= 0 or self.weight_decay < 0 or self.clip_norm <= 0:
            raise ValueError("learning_rate and clip_norm must be positive, weight_decay >= 0.")
        if not 0 < self.holdout < 1 or not 0 <= self.warm_fraction < 1:
            raise ValueError("holdout must lie in (0, 1) and warm_fraction in [0, 1).")


@dataclass(frozen=True)
class RecurrentEnsemble:
    """A fitted ensemble.

    Attributes:
        weight: ``[2K, H, H + 6]``: columns hidden state, setpoint, velocity, gain, shift, own
            previous value, bias.
        readout: ``[2K, 1, H + 1]``.
        frames: Scaling of the six frame features.
        low: ``[2]`` smallest normalised fatigue and consumption seen in training data.
        high: ``[2]`` largest.
    """

    weight: Tensor
    readout: Tensor
    frames: Normaliser
    low: Tensor
    high: Tensor

    @property
    def members(self) -> int:
        """Number of network pairs K."""
        return int(self.weight.shape[0]) // len(TARGETS)

    def save(self, folder: Path) -> None:
        """Write one safetensors file into an existing folder."""
        tensors = {
            "weight": self.weight,
            "readout": self.readout,
            "mean": self.frames.mean,
            "scale": self.frames.scale,
            "low": self.low,
            "high": self.high,
        }
        save_tensors(folder / FILE, tensors, {"format": FORMAT})

    @classmethod
    def load(cls, folder: Path) -> "RecurrentEnsemble":
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: If the file holds something else.
        """
        path = folder / FILE
        tensors, header = load_tensors(path)
        if header.get("format") != FORMAT:
            raise ValueError(f"{path} holds {header.get('format')!r}, expected {FORMAT!r}.")
        frames = Normaliser(tensors["mean"], tensors["scale"])
        return cls(tensors["weight"], tensors["readout"], frames, tensors["low"], tensors["high"])


def predict_windows(
    weight: Tensor, readout: Tensor, windows: Tensor, config: RecurrentEnsembleConfig
) -> Tensor:
    """Unroll all networks over recorded windows.

    Args:
        weight: ``[M, H, H + 6]``.
        readout: ``[M, 1, H + 1]``.
        windows: ``[G + F, M, 5, B]``: normalised post-action steerings and previous own value.
        config: For G.

    Returns:
        Normalised predictions of the F last steps, ``[F, M, B]``.
    """
    cells, width = weight.shape[0], weight.shape[1]
    hidden = windows.new_zeros(cells, width, windows.shape[-1])
    observed = config.warm_up + 1  # the first prediction still starts from a recorded value
    first, hidden = unroll_cells(weight, readout, hidden, windows[:observed])
    # Only the fatigue networks, the first half, feed their reading back.
    feeds_back = (torch.arange(cells, device=weight.device) < cells // len(TARGETS))[:, None, None]
    own = weight[:, :, width + len(INPUTS), None] * feeds_back
    recurrent = weight[:, :, :width] + own * readout[:, :, :-1]
    bias = weight[:, :, -1:] + own * readout[:, :, -1:]
    closed = torch.cat([recurrent, weight[:, :, width : width + len(INPUTS)], bias], dim=2)
    later, _ = unroll_cells(closed, readout, hidden, windows[observed:, :, : len(INPUTS)])
    return torch.cat([first[-1:], later])
