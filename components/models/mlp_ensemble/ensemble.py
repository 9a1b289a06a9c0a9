"""Ensembles of multilayer perceptrons that predict one step of a partly observed system.

K members read the last frames that policies see, newest first, and the known features of the next
model frame, which follow from the action exactly; they predict its learned features, as values
or, where policies see them, as changes. Outputs are standardised: in units of ``target_scale``
around ``target_mean``, both in normalised feature units. Gaussian members predict a log variance
for every target as well, kept inside learned bounds by softplus from both sides (Chua et al. 2018,
as in MOPO).

The three kinds in use, which differ in size, loss and schedule only: deterministic for MOOSE
(thesis 5.1), Gaussian for MOPO, residual for MOReL. How they are trained is in
:mod:`components.models.mlp_ensemble.fit`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from components.core.normaliser import Normaliser
from components.core.tensors import load_tensors, save_tensors
from components.models.rescaling import read_in_scaling
from components.models.transition.interface import Prediction
from components.networks.stacked import Activation

__all__ = ["ACTIVATIONS", "MLPEnsemble", "MLPTransition", "bounded_log_variance"]

FORMAT = "mlp-ensemble/2"
FILE = "ensemble.safetensors"

ACTIVATIONS: Final = MappingProxyType[str, Activation]({"relu": torch.relu_, "swish": silu})


@dataclass(frozen=True)
class MLPEnsemble:
    """A fitted ensemble.

    Attributes:
        layers: Weights ``[K, in, out]`` and biases ``[K, 1, out]``. Inputs are H frames, newest
            first, then the next model frame's known features, all normalised; outputs are D
            standardised targets, for Gaussian members D log variances after them.
        frames: Scaling of a model frame's features ``[M]``; the last D are the learned ones.
        observed: Index of the first feature that policies see, and of the first one after these.
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
    observed: tuple[int, int]
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

    @property
    def shape(self) -> tuple[object, ...]:
        """Kind and sizes, which must be equal for all lanes of a stack."""
        widths = tuple(int(weight.shape[2]) for weight, _ in self.layers)
        kind = "gaussian" if self.log_variance.numel() else "deterministic"
        sizes = (self.members, len(self.elites), self.history, *self.observed)
        return kind, *sizes, self.activation, *widths

    @property
    def changes(self) -> Tensor:
        """1 where a change is predicted, 0 where a value is, ``[D]``."""
        first, last = self.observed
        place = torch.arange(len(self.frames.mean))[-len(self.low) :]
        return ((first <= place) & (place < last)).float() * float(self.target == "change")

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
            "observed": list(self.observed),
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
            observed=tuple(header["observed"]),
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
    """Ensembles of L lanes as a :class:`TransitionModel`.

    Args:
        ensembles: One per lane, of equal shapes.
        scaling: Scaling of the frames that policies see, ``[L, F]``; the conversion to the models'
            own scaling is folded into the first layer.
        device: Where to compute.

    Raises:
        ValueError: If the ensembles differ in more than their numbers and target forms.
    """

    def __init__(
        self, ensembles: Sequence[MLPEnsemble], scaling: Normaliser, device: torch.device
    ) -> None:
        first = ensembles[0]
        if len({e.shape for e in ensembles}) != 1:
            raise ValueError(
                "Lanes of one stack need ensembles of equal members, layers, history and kind, got "
                f"{' and '.join(sorted({str(e.shape) for e in ensembles}))}."
            )
        self.members, self.memory = first.members, 1
        self.frames = Normaliser.stack([e.frames for e in ensembles]).to(device)
        self.low = torch.stack([e.low for e in ensembles]).to(device)
        self.high = torch.stack([e.high for e in ensembles]).to(device)
        self.target_scale = torch.stack([e.target_scale for e in ensembles]).to(device)
        self.elites = torch.tensor([e.elites for e in ensembles], device=device)  # [L, E]
        self._target_mean = torch.stack([e.target_mean for e in ensembles]).to(device)
        bounds = [e.log_variance for e in ensembles]
        self._bounds = torch.cat(bounds).to(device) if bounds[0].numel() else None
        self._layers = [
            (
                torch.cat([e.layers[n][0] for e in ensembles]).to(device),
                torch.cat([e.layers[n][1] for e in ensembles]).to(device),
            )
            for n in range(len(first.layers))
        ]
        self._activation = ACTIVATIONS[first.activation]
        # Which form predicts better is chosen dataset by dataset, so it may differ among lanes.
        self._changes = torch.stack([e.changes for e in ensembles]).to(device)[:, :, None, None]
        shown = slice(*first.observed)
        self._seen = first.history * (shown.stop - shown.start)  # width of the frames read
        weight, bias = self._layers[0]
        own = Normaliser(self.frames.mean[:, shown], self.frames.scale[:, shown])
        given = scaling.to(device)
        weight, bias = read_in_scaling(weight, bias, own, given, first.history)
        self._layers[0] = weight, bias
        # [L, in, K * out]: the members' weights side by side, where all read the same rows.
        by_member = weight.view(len(ensembles), self.members, *weight.shape[1:])
        self._side_by_side = by_member.transpose(1, 2).flatten(2)

    def begin(self, past: Tensor) -> None:
        """No state: a step depends on the frames alone."""

    def predict(
        self, state: None, observation: Tensor, known: Tensor, own: Tensor
    ) -> tuple[Prediction, None]:
        """One step of all members."""
        lanes, copies, batch, _ = known.shape
        seen = torch.cat([observation[..., : self._seen], known], dim=-1)
        weight, bias = self._layers[0]
        if copies == 1:
            x = torch.bmm(seen[:, 0], self._side_by_side)  # one product for all members of a lane
            x = x.view(lanes, batch, self.members, -1).transpose(1, 2).flatten(0, 1) + bias
        else:
            x = torch.baddbmm(bias, seen.flatten(0, 1), weight)
        for weight, bias in self._layers[1:]:
            x = torch.baddbmm(bias, self._activation(x), weight)
        out = x.view(lanes, self.members, batch, -1).permute(0, 3, 1, 2)  # [L, D or 2D, K, B]
        count = self.low.shape[1]
        scale, mean = (t[:, :, None, None] for t in (self.target_scale, self._target_mean))
        values = out[:, :count] * scale + mean + self._changes * own
        if self._bounds is None:
            return Prediction(values), None
        low, high = self._bounds.view(lanes, self.members, 2, count, 1).permute(2, 0, 3, 1, 4)
        log_variance = bounded_log_variance(out[:, count:], low, high)
        return Prediction(values, torch.exp(0.5 * log_variance)), None
