"""Ensembles of multilayer perceptrons that predict one step of a partly observed machine.

K members read the last frames, newest first, and the inputs of the next frame, which follow from
the action exactly; they predict its targets (fatigue and consumption), either as values or as
changes. Outputs are standardised: in units of ``target_scale`` around ``target_mean``, both in
normalised feature units. Gaussian members predict a log variance for every target as well, kept
inside learned bounds by softplus from both sides (Chua et al. 2018, as in MOPO).

The three kinds in use, which differ in size, loss and schedule only: deterministic for MOOSE
(thesis 5.1), Gaussian for MOPO, residual for MOReL. How they are trained is in
:mod:`components.models.mlp_fit`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from components.data.normaliser import Normaliser
from components.models.rollout import TARGETS, Prediction
from components.networks.checkpoint import load_tensors, save_tensors
from components.networks.stacked import Activation

__all__ = ["ACTIVATIONS", "MLPEnsemble", "MLPTransition", "bounded_log_variance"]

FORMAT = "mlp-ensemble/1"
FILE = "ensemble.safetensors"

ACTIVATIONS: Final = MappingProxyType[str, Activation]({"relu": torch.relu, "swish": silu})


@dataclass(frozen=True)
class MLPEnsemble:
    """A fitted ensemble.

    Attributes:
        layers: Weights ``[K, in, out]`` and biases ``[K, 1, out]``. Inputs are H frames, newest
            first, then the next frame's inputs, all normalised; outputs are D standardised targets,
            for Gaussian members D log variances after them.
        frames: Scaling of the frame's features ``[F]``.
        low: ``[D]`` smallest normalised targets of the training data.
        high: ``[D]`` largest.
        target_mean: ``[D]`` mean of what is predicted, in normalised units; 0 for values.
        target_scale: ``[D]`` its deviation; 1 for values.
        log_variance: ``[K, 2, D]`` bounds of the log variances; empty for deterministic members.
        history: H.
        activation: Name in :data:`ACTIVATIONS`.
        target: ``value`` or ``change``.
        elites: Members of lowest held-out error, best first.
    """

    layers: tuple[tuple[Tensor, Tensor], ...]
    frames: Normaliser
    low: Tensor
    high: Tensor
    target_mean: Tensor
    target_scale: Tensor
    log_variance: Tensor
    history: int
    activation: str
    target: str
    elites: tuple[int, ...]

    @property
    def members(self) -> int:
        """Number of members K."""
        return int(self.layers[0][0].shape[0])

    def save(self, folder: Path) -> None:
        """Write one safetensors file into an existing folder."""
        names = ("low", "high", "target_mean", "target_scale", "log_variance")
        tensors = {name: getattr(self, name) for name in names}
        tensors |= {"mean": self.frames.mean, "scale": self.frames.scale}
        for number, (weight, bias) in enumerate(self.layers):
            tensors |= {f"{number}.weight": weight, f"{number}.bias": bias}
        header = {
            "format": FORMAT,
            "layers": len(self.layers),
            "history": self.history,
            "activation": self.activation,
            "target": self.target,
            "elites": list(self.elites),
        }
        save_tensors(folder / FILE, tensors, header)

    @classmethod
    def load(cls, folder: Path) -> "MLPEnsemble":
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: If the file holds something else.
        """
        tensors, header = load_tensors(folder / FILE)
        if header.get("format") != FORMAT:
            raise ValueError(
                f"{folder / FILE} holds {header.get('format')!r}, expected {FORMAT!r}."
            )
        names = ("low", "high", "target_mean", "target_scale", "log_variance")
        return cls(
            layers=tuple(
                (tensors[f"{n}.weight"], tensors[f"{n}.bias"]) for n in range(header["layers"])
            ),
            frames=Normaliser(tensors["mean"], tensors["scale"]),
            history=header["history"],
            activation=header["activation"],
            target=header["target"],
            elites=tuple(header["elites"]),
            **{name: tensors[name] for name in names},
        )


def bounded_log_variance(raw: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Log variances kept between two bounds, smoothly, so that the bounds can be learned."""
    below = high - softplus(high - raw)
    return low + softplus(below - low)


class MLPTransition:
    """Ensembles of L lanes as a transition model, see :mod:`components.models.rollout`.

    Args:
        ensembles: One per lane, of equal shapes and kinds.
        scaling: Scaling of the frames that policies see, ``[L, F]``; the change to the models' own
            is folded into the first layer.
        device: Where to compute.
    """

    def __init__(
        self, ensembles: Sequence[MLPEnsemble], scaling: Normaliser, device: torch.device
    ) -> None:
        first = ensembles[0]
        self.members = first.members
        self.frames = Normaliser.stack([e.frames for e in ensembles]).to(device)
        self.low = torch.stack([e.low for e in ensembles]).to(device)
        self.high = torch.stack([e.high for e in ensembles]).to(device)
        self.target_scale = torch.stack([e.target_scale for e in ensembles]).to(device)
        self.elites = torch.tensor([e.elites for e in ensembles], device=device)  # [L, E]
        self._target_mean = torch.stack([e.target_mean for e in ensembles]).to(device)
        bounds = [e.log_variance for e in ensembles]
        self._bounds = torch.cat(bounds).to(device) if bounds[0].numel() else None
        self._layers = [
            tuple(torch.cat([e.layers[n][part] for e in ensembles]).to(device) for part in (0, 1))
            for n in range(len(first.layers))
        ]
        self._activation = ACTIVATIONS[first.activation]
        self._changes = first.target == "change"
        self._seen = first.history * len(first.frames.mean)  # width of the frames that are read
        self._fold(scaling.to(device), first.history)

    def _fold(self, scaling: Normaliser, history: int) -> None:
        """Let the first layer read frames in the policies' scaling instead of the models'."""
        own = self.frames
        factor = (scaling.scale / own.scale).repeat(1, history)  # [L, H * F]
        offset = ((scaling.mean - own.mean) / own.scale).repeat(1, history)
        weight, bias = self._layers[0]
        seen = weight[:, : self._seen].view(len(factor), self.members, self._seen, -1)
        moved = torch.einsum("li,lkio->lko", offset, seen).flatten(0, 1)[:, None]
        scaled = (factor[:, None, :, None] * seen).flatten(0, 1)
        self._layers[0] = (torch.cat([scaled, weight[:, self._seen :]], dim=1), bias + moved)

    def begin(self, history: Tensor) -> None:
        """Nothing is remembered between steps but the frames."""

    def predict(
        self, state: None, observation: Tensor, inputs: Tensor, own: Tensor
    ) -> tuple[Prediction, None]:
        """One step of all members."""
        lanes, copies, batch, _ = inputs.shape
        seen = torch.cat([observation[..., : self._seen], inputs], dim=-1)
        weight, bias = self._layers[0]
        if copies == 1:
            # All members of a lane read the same rows: one product with their weights side by side.
            side_by_side = weight.view(lanes, self.members, *weight.shape[1:]).transpose(1, 2)
            x = torch.bmm(seen[:, 0], side_by_side.flatten(2))
            x = x.view(lanes, batch, self.members, -1).transpose(1, 2).flatten(0, 1) + bias
        else:
            x = torch.baddbmm(bias, seen.flatten(0, 1), weight)
        for weight, bias in self._layers[1:]:
            x = torch.baddbmm(bias, self._activation(x), weight)
        out = x.view(lanes, self.members, batch, -1).permute(0, 3, 1, 2)  # [L, D or 2D, K, B]
        count = len(TARGETS)
        scale, mean = (t[:, :, None, None] for t in (self.target_scale, self._target_mean))
        values = out[:, :count] * scale + mean
        if self._changes:
            values = values + own
        if self._bounds is None:
            return Prediction(values), None
        low, high = self._bounds.view(lanes, self.members, 2, count, 1).permute(2, 0, 3, 1, 4)
        log_variance = bounded_log_variance(out[:, count:], low, high)
        return Prediction(values, torch.exp(0.5 * log_variance)), None
