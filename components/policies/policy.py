"""Deployable policies: stacks of networks with everything needed to act on raw frames.

An artifact is a folder of two files: ``policy.json`` (what the policy is: how it acts, history
rule, features, whether it takes the proximity parameter, snapshot steps, format) and
``weights.safetensors`` (numbers, the normaliser among them). Nothing in it is ever unpickled. The
lane axis of a stored policy counts the snapshots of one training run.

How a policy acts is named on its card, see :mod:`components.policies.deployment`. Most are
deterministic networks. BCQ and BEAR choose, by a critic, among candidates drawn at every state; the
caller supplies the normal noise, so that a policy's actions depend on its own random stream alone.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import torch
from torch import Tensor

from components.core.cards import CardFormat
from components.core.files import write_text
from components.core.integrity import DamagedFileError
from components.core.normaliser import Normaliser
from components.core.tensors import load_tensors, save_tensors
from components.policies.deployment import KINDS, Layers

__all__ = ["PROXIMITY_SCALING", "Policy", "PolicyCard"]

FORMAT: Final = "policy/2"
_STORED_NAMES: Final = MappingProxyType({"takes_proximity": "takes_lambda"})
"""Fields that have another name in `policy.json`."""
PROXIMITY_SCALING = Normaliser(torch.tensor([0.5]), torch.tensor([0.2887]))
"""Moments of a uniform proximity, as LION's reference implementation scales its input."""


@dataclass(frozen=True, kw_only=True)
class PolicyCard:
    """What a policy artifact is.

    Attributes:
        algorithm: Name of the learner.
        dataset: Name of the dataset it learned from.
        features: Names of a frame's features, in order.
        history: Frames in an observation, newest first; before the start the first one repeats.
        actions: Width of the action, every entry in [-1, 1].
        takes_proximity: Whether the proximity parameter is an input.
        steps: Training step of every stored snapshot, one per lane.
        kind: How it acts, a name in :data:`~components.policies.deployment.KINDS`.
        candidates: N, actions drawn per state; 0 if the policy is deterministic.
        noise: Width of the normal noise from which a candidate is made.
        perturbation: Largest change BCQ's actor may make to a generated action.
        ended_at: Update by which a loss, a weight or an action in the log's states had become
            infinite or undefined and learning ended; the snapshots after it repeat the last finite
            one. None: training used the whole budget.
    """

    algorithm: str
    dataset: str
    features: tuple[str, ...]
    history: int
    actions: int
    takes_proximity: bool
    steps: tuple[int, ...]
    kind: str = "tanh"
    candidates: int = 0
    noise: int = 0
    perturbation: float = 0.0
    ended_at: int | None = None

    def __post_init__(self) -> None:
        """Reject an unknown kind of policy.

        Raises:
            ValueError: Naming the known kinds.
        """
        if self.kind not in KINDS:
            raise ValueError(f"it acts by {self.kind!r}, known are {', '.join(KINDS)}")

    @classmethod
    def load(cls, path: Path) -> "PolicyCard":
        """Read ``policy.json``.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is damaged or of another format.
        """
        return _CARDS.read(path)

    def to_json(self) -> str:
        """The text of ``policy.json``."""
        values = {_STORED_NAMES.get(name, name): value for name, value in asdict(self).items()}
        return json.dumps({"format": FORMAT, **values}, indent=2, allow_nan=False) + "\n"


def _amend(values: dict[str, Any]) -> None:
    for name, stored in _STORED_NAMES.items():
        if stored in values:
            values[name] = values.pop(stored)


_CARDS: Final = CardFormat(
    kind=PolicyCard,
    what="policy",
    remedy="train the policy again",
    version=("format", FORMAT),
    amend=_amend,
)


@dataclass(frozen=True)
class Policy:
    """P policies side by side.

    Attributes:
        card: Their common card.
        networks: Layers by role; there always is an ``actor``.
        frames: Scaling of a frame's features, ``[P, F]``.
        proximity_scaling: Scaling of the proximity ``[P, 1]`` before it enters the actor; unused by
            policies that take none.
    """

    card: PolicyCard
    networks: Mapping[str, Layers]
    frames: Normaliser
    proximity_scaling: Normaliser

    @classmethod
    def of_networks(
        cls,
        card: PolicyCard,
        networks: Mapping[str, Sequence[tuple[Tensor, Tensor]]],
        frames: Normaliser,
        proximity_scaling: Normaliser = PROXIMITY_SCALING,
    ) -> "Policy":
        """Copy trained stacks, one policy per lane."""
        copied = {
            role: tuple((_copy(weight), _copy(bias)) for weight, bias in layers)
            for role, layers in networks.items()
        }
        lanes = copied["actor"][0][0].shape[0]
        scaling = Normaliser(_copy(frames.mean), _copy(frames.scale))
        of_proximity = Normaliser(
            *(
                _copy(t).expand(lanes, 1).clone()
                for t in (proximity_scaling.mean, proximity_scaling.scale)
            )
        )
        return cls(card, copied, scaling, of_proximity)

    @classmethod
    def concatenate(cls, card: PolicyCard, parts: Sequence["Policy"]) -> "Policy":
        """Stack policies of one kind and of equal shapes under one card."""
        tensors = [part._tensors() for part in parts]
        joined = {name: torch.cat([t[name] for t in tensors]) for name in tensors[0]}
        return cls._of_tensors(card, joined)

    @property
    def lanes(self) -> int:
        """Number of policies P."""
        return int(self.layers[0][0].shape[0])

    @property
    def layers(self) -> Layers:
        """The actor's layers."""
        return self.networks["actor"]

    @property
    def finite(self) -> Tensor:
        """Whether all numbers of a policy are finite, ``[P]``."""
        flat = [t.flatten(1).isfinite().all(dim=1) for t in self._tensors().values()]
        return torch.stack(flat).all(dim=0)

    def lane(self, number: int, card: PolicyCard) -> "Policy":
        """One policy of the stack, as a stack of one."""
        return self.select(slice(number, number + 1), card)

    def select(self, lanes: slice, card: PolicyCard) -> "Policy":
        """Some policies of the stack."""
        return self._of_tensors(card, {n: t[lanes] for n, t in self._tensors().items()})

    def to(self, device: torch.device) -> "Policy":
        """The same on another device."""
        return self._of_tensors(self.card, {n: t.to(device) for n, t in self._tensors().items()})

    @torch.no_grad()
    def act(
        self, histories: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose actions.

        Args:
            histories: ``[P, B, H, F]`` raw frames, newest first.
            proximity: ``[P, B]`` in [0, 1]; needed exactly if the card says so.
            noise: ``[P, B, candidates, noise]`` standard normal; needed exactly if the card
                names candidates.

        Returns:
            ``[P, B, A]`` in [-1, 1].

        Raises:
            ValueError: If proximity or noise is missing, or given to policies that take none.
        """
        for given, wanted, what in (
            (proximity, self.card.takes_proximity, "proximity"),
            (noise, self.card.candidates > 0, "noise"),
        ):
            if (given is not None) != wanted:
                says = "needs" if wanted else "does not take"
                raise ValueError(f"A policy of {self.card.algorithm} {says} {what}.")
        mean, scale = self.frames.mean[:, None, None], self.frames.scale[:, None, None]
        x = ((histories - mean) / scale).flatten(start_dim=2)
        if proximity is not None:
            scaled = (proximity - self.proximity_scaling.mean) / self.proximity_scaling.scale
            x = torch.cat([x, scaled[..., None]], dim=-1)
        return KINDS[self.card.kind](self.networks, x, noise, self.card.perturbation)

    def save(self, folder: Path) -> None:
        """Write the artifact into an existing folder; ``policy.json`` appears last.

        Raises:
            ValueError: If a number is infinite or undefined: such a policy is never stored.
        """
        if wrong := _undefined(self._tensors()):
            raise ValueError(
                f"A policy of {self.card.algorithm} on {self.card.dataset} is not finite in "
                f"{wrong}, so it is not stored."
            )
        text = self.card.to_json()
        header = {
            "format": FORMAT,
            "networks": {r: len(n) for r, n in self.networks.items()},
            "card": hashlib.sha256(text.encode()).hexdigest(),
        }
        save_tensors(folder / "weights.safetensors", self._tensors(), header)
        write_text(folder / "policy.json", text, durable=True)

    @classmethod
    def load(cls, folder: Path) -> "Policy":
        """Read what :meth:`save` wrote.

        Raises:
            MissingFileError: If the folder holds no policy.
            DamagedFileError: If the files are damaged or of another format, or a number is infinite
                or undefined.
        """
        path, weights = folder / "policy.json", folder / "weights.safetensors"
        card = PolicyCard.load(path)
        tensors, header = load_tensors(weights)
        if "card" in header and header["card"] != hashlib.sha256(path.read_bytes()).hexdigest():
            said = f"{path} is damaged (it is not the card that {weights.name} was written with)"
            raise DamagedFileError(said, path, _CARDS.remedy)
        if wrong := _undefined(tensors):
            raise DamagedFileError(f"{weights} is not finite in {wrong}", weights, _CARDS.remedy)
        try:
            for role, count in header["networks"].items():
                for name in (f"{role}.{n}.{p}" for n in range(count) for p in ("weight", "bias")):
                    tensors[name]
            return cls._of_tensors(card, tensors)
        except (KeyError, AttributeError, TypeError) as error:
            raise DamagedFileError(f"{weights} lacks {error}", weights, _CARDS.remedy) from error

    def _tensors(self) -> dict[str, Tensor]:
        """All tensors by stored name, lane axis first."""
        tensors = {
            "frames.mean": self.frames.mean,
            "frames.scale": self.frames.scale,
            "steering.mean": self.proximity_scaling.mean,
            "steering.scale": self.proximity_scaling.scale,
        }
        for role, layers in self.networks.items():
            for number, (weight, bias) in enumerate(layers):
                tensors[f"{role}.{number}.weight"] = weight
                tensors[f"{role}.{number}.bias"] = bias
        return tensors

    @classmethod
    def _of_tensors(cls, card: PolicyCard, tensors: Mapping[str, Tensor]) -> "Policy":
        networks: dict[str, Layers] = {}
        numbered = [name.split(".") for name in tensors if name.endswith(".weight")]
        for role, number in sorted((role, int(number)) for role, number, _ in numbered):
            layer = tensors[f"{role}.{number}.weight"], tensors[f"{role}.{number}.bias"]
            networks[role] = (*networks.get(role, ()), layer)
        frames = Normaliser(tensors["frames.mean"], tensors["frames.scale"])
        proximity_scaling = Normaliser(tensors["steering.mean"], tensors["steering.scale"])
        if "actor" not in networks:
            raise KeyError("actor")
        return cls(card, networks, frames, proximity_scaling)


def _undefined(tensors: Mapping[str, Tensor]) -> str:
    """Names of the tensors with infinite or undefined numbers."""
    return ", ".join(name for name, tensor in tensors.items() if not tensor.isfinite().all())


def _copy(tensor: Tensor) -> Tensor:
    return tensor.detach().cpu().clone()
