"""Recurrent transition ensemble for partly observed systems (thesis 3.3.2, 6.2).

The known features of the next model frame follow from the action exactly, so the networks see the
frame *after* the action: its known features, normalised, and previous values of what they predict.
They predict the learned features: K members, each either one network per feature or a single one
for all of them. A *group* is the K networks that predict the same features.

A network reads back those of its own features that a log's frames show, except the memoryless ones:
on the Industrial Benchmark fatigue depends on its own previous value and consumption does not; of a
robot everything is read back except the reward. Targets are the normalised values in the next frame
or, for features that are read back, their changes.

The hidden state is built up on recorded frames; after the first predicted step networks are fed
their own predictions, unclipped (thesis 6.2, eq. 3.41). If these are values, the reading is
linear in the hidden state and feeding it back equals using another recurrent matrix,
``W_h + w_self r``: both phases are plain scans over known inputs. Changes have to be added up to
values, which the cell carries from step to step.

How the networks are trained is in :mod:`components.models.recurrent_ensemble.fit`.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.tensors import load_tensors, save_tensors
from components.data.dynamics import DynamicsSpecification
from components.networks.recurrent import unroll_cells, unroll_loops

__all__ = ["Feedback", "RecurrentEnsemble", "RecurrentEnsembleConfig", "predict_windows"]

FORMAT = "recurrent-ensemble/2"
FILE = "ensemble.safetensors"


@dataclass(frozen=True, kw_only=True)
class RecurrentEnsembleConfig:
    """How the ensemble is built and trained."""

    members: int = 4  # K
    networks: str = "separate"  # one per learned feature and member; or joint: one for all features
    memoryless: tuple[str, ...] = ("consumption",)  # learned features that no network reads back
    target: str = "value"  # predicted; or change, of features that are read back
    hidden: int = 30  # units of each tanh cell
    warm_up: int = 30  # G, recorded steps that build up the hidden state
    horizon: int = 50  # F, predicted steps that enter the loss
    batch: int = 256  # windows per update and network
    updates: int = 3000  # budget; training may stop earlier
    learning_rate: float = 5e-3  # peak of the one-cycle schedule
    warm_fraction: float = 0.1  # part of the budget over which the rate rises
    weight_decay: float = 0.0  # L2 term inside Adam
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
        if self.networks not in ("separate", "joint") or self.target not in ("value", "change"):
            raise ValueError("networks must be separate or joint and target value or change.")
        if self.learning_rate <= 0 or self.weight_decay < 0 or self.clip_norm <= 0:
            raise ValueError("learning_rate and clip_norm must be positive, weight_decay >= 0.")
        if not 0 < self.holdout < 1 or not 0 <= self.warm_fraction < 1:
            raise ValueError("holdout must lie in (0, 1) and warm_fraction in [0, 1).")


@dataclass(frozen=True)
class Feedback:
    """Which of its first D' features the networks of each group read back.

    Attributes:
        reads: ``[groups, D']`` 1 where the previous value is an input, 0 where it is not.
        adds: ``[groups, D']`` 1 where its change is predicted, 0 where the next value is.
        sums: Whether ``adds`` has any 1.
    """

    reads: Tensor
    adds: Tensor
    sums: bool

    @classmethod
    def of(cls, config: RecurrentEnsembleConfig, dynamics: DynamicsSpecification) -> "Feedback":
        """The feedback for the learned features of a dynamics specification, in their order."""
        wanted = [
            float(shown and name not in config.memoryless)
            for name, shown in zip(dynamics.learned, dynamics.shown, strict=True)
        ]
        groups = 1 if config.networks == "joint" else len(wanted)
        reads = torch.tensor(wanted).view(groups, -1)
        # D' ends with the last feature that any group reads; later columns would be zero.
        looped = int(reads.any(dim=0).nonzero().max()) + 1 if any(wanted) else 0
        reads = reads[:, :looped].contiguous()
        return cls.stored(reads, reads * float(config.target == "change"))

    @classmethod
    def stored(cls, reads: Tensor, adds: Tensor) -> "Feedback":
        """From its two tensors."""
        return cls(reads, adds, bool(adds.any()))

    def to(self, device: torch.device) -> "Feedback":
        """The same on another device."""
        return Feedback(self.reads.to(device), self.adds.to(device), self.sums)


@dataclass(frozen=True)
class RecurrentEnsemble:
    """A fitted ensemble; its networks are ordered by group, then by member.

    Attributes:
        weight: ``[M, H, H + known + D' + 1]``: columns hidden state, known features, own previous
            values, bias.
        readout: ``[M, O, H + 1]``, O learned features of a group.
        frames: Scaling of a model frame's features.
        low: ``[D]`` smallest normalised learned features seen in training data.
        high: ``[D]`` largest.
        feedback: What is read back.
        warm_up: G, recorded frames that build up the hidden state before a prediction.
    """

    weight: Tensor
    readout: Tensor
    frames: Normaliser
    low: Tensor
    high: Tensor
    feedback: Feedback
    warm_up: int

    @property
    def members(self) -> int:
        """Number of networks K of a group."""
        return int(self.weight.shape[0]) // len(self.feedback.reads)

    def save(self, folder: Path) -> None:
        """Write one safetensors file into an existing folder."""
        tensors = {
            "weight": self.weight,
            "readout": self.readout,
            "mean": self.frames.mean,
            "scale": self.frames.scale,
            "low": self.low,
            "high": self.high,
            "reads": self.feedback.reads,
            "adds": self.feedback.adds,
        }
        save_tensors(folder / FILE, tensors, {"format": FORMAT, "warm_up": self.warm_up})

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
        return cls(
            weight=tensors["weight"],
            readout=tensors["readout"],
            frames=Normaliser(tensors["mean"], tensors["scale"]),
            low=tensors["low"],
            high=tensors["high"],
            feedback=Feedback.stored(tensors["reads"], tensors["adds"]),
            warm_up=header["warm_up"],
        )


def predict_windows(
    weight: Tensor, readout: Tensor, windows: Tensor, warm_up: int, feedback: Feedback
) -> Tensor:
    """Unroll all networks over recorded windows.

    Args:
        weight: ``[M, H, H + known + D' + 1]``.
        readout: ``[M, O, H + 1]``.
        windows: ``[G + F, M, known + D', B]``: normalised known features after the action and own
            values before it, zero where a group does not read them.
        warm_up: G.
        feedback: Of the groups.

    Returns:
        Normalised predictions of the F last steps, ``[F, M * O, B]``, network by network.
    """
    cells, width = weight.shape[0], weight.shape[1]
    looped = feedback.reads.shape[1]
    known = windows.shape[2] - looped
    members = cells // len(feedback.reads)
    reads, adds = (
        of_group.repeat_interleave(members, dim=0)[:, :, None]
        for of_group in (feedback.reads, feedback.adds)
    )
    hidden = windows.new_zeros(cells, width, windows.shape[-1])
    observed = warm_up + 1  # the first prediction still starts from recorded values
    first, hidden = unroll_cells(weight, readout, hidden, windows[:observed])
    if feedback.sums:
        recorded = windows[observed - 1, :, known:]
        values = first[-1].view(cells, -1, windows.shape[-1])
        own = values[:, :looped] + adds * recorded
        values = torch.cat([own, values[:, looped:]], dim=1)
        later, _ = unroll_loops(
            weight, readout, hidden, windows[observed:, :, :known], reads * own, reads, adds
        )
        return torch.cat([values.flatten(0, 1)[None], later])
    own = (weight[:, :, width + known : -1] * reads.transpose(1, 2))[..., None]  # [M, H, D', 1]
    fed = readout[:, None, :looped]  # [M, 1, D', H + 1]
    recurrent = weight[:, :, :width] + (own * fed[..., :-1]).sum(dim=2)
    bias = weight[:, :, -1:] + (own * fed[..., -1:]).sum(dim=2)
    closed = torch.cat([recurrent, weight[:, :, width : width + known], bias], dim=2)
    later, _ = unroll_cells(closed, readout, hidden, windows[observed:, :, :known])
    return torch.cat([first[-1:], later])
