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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.core.files import write_text
from components.core.integrity import DamagedFileError
from components.core.normaliser import Normaliser
from components.core.tensors import load_tensors, save_tensors
from components.policies.card import CARDS, FORMAT, PolicyCard
from components.policies.deployment import KINDS, Layers, critic_values

__all__ = ["PROXIMITY_SCALING", "Policy", "PolicyCard"]

PROXIMITY_SCALING = Normaliser(torch.tensor([0.5]), torch.tensor([0.2887]))
"""Moments of a uniform proximity, as LION's reference implementation scales its input."""


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
        tensors = [part.tensors() for part in parts]
        joined = {name: torch.cat([t[name] for t in tensors]) for name in tensors[0]}
        return cls.of_tensors(card, joined)

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
        flat = [t.flatten(1).isfinite().all(dim=1) for t in self.tensors().values()]
        return torch.stack(flat).all(dim=0)

    def lane(self, number: int, card: PolicyCard) -> "Policy":
        """One policy of the stack, as a stack of one."""
        return self.select(slice(number, number + 1), card)

    def select(self, lanes: slice, card: PolicyCard) -> "Policy":
        """Some policies of the stack."""
        return self.of_tensors(card, {n: t[lanes] for n, t in self.tensors().items()})

    def to(self, device: torch.device) -> "Policy":
        """The same on another device."""
        return self.of_tensors(self.card, {n: t.to(device) for n, t in self.tensors().items()})

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
        x = self._observed(histories, proximity)
        return KINDS[self.card.kind](self.networks, x, noise, self.card.perturbation)

    @torch.no_grad()
    def values(self, histories: Tensor, actions: Tensor, proximity: Tensor | None = None) -> Tensor:
        """What the critic of policies that choose among candidates thinks of other actions.

        Args:
            histories: ``[P, B, H, F]`` raw frames, newest first.
            actions: ``[P, B, A]`` in [-1, 1].
            proximity: As in :meth:`act`.

        Returns:
            ``[P, B]``.
        """
        return critic_values(self.networks, self._observed(histories, proximity), actions)

    def save(self, folder: Path) -> None:
        """Write the artifact into an existing folder; ``policy.json`` appears last.

        Raises:
            ValueError: If a number is infinite or undefined: such a policy is never stored.
        """
        if wrong := _undefined(self.tensors()):
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
        save_tensors(folder / "weights.safetensors", self.tensors(), header)
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
            raise DamagedFileError(said, path, CARDS.remedy)
        if wrong := _undefined(tensors):
            raise DamagedFileError(f"{weights} is not finite in {wrong}", weights, CARDS.remedy)
        try:
            for role, count in header["networks"].items():
                for name in (f"{role}.{n}.{p}" for n in range(count) for p in ("weight", "bias")):
                    tensors[name]
            return cls.of_tensors(card, tensors)
        except (KeyError, AttributeError, TypeError) as error:
            raise DamagedFileError(f"{weights} lacks {error}", weights, CARDS.remedy) from error

    def tensors(self) -> dict[str, Tensor]:
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
    def of_tensors(cls, card: PolicyCard, tensors: Mapping[str, Tensor]) -> "Policy":
        """The policies whose :meth:`tensors` these are.

        Raises:
            KeyError: One is missing.
        """
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

    def _observed(self, histories: Tensor, proximity: Tensor | None) -> Tensor:
        """What the networks see, ``[P, B, O]``."""
        mean, scale = self.frames.mean[:, None, None], self.frames.scale[:, None, None]
        x = ((histories - mean) / scale).flatten(start_dim=2)
        if proximity is None:
            return x
        scaled = (proximity - self.proximity_scaling.mean) / self.proximity_scaling.scale
        return torch.cat([x, scaled[..., None]], dim=-1)


def _undefined(tensors: Mapping[str, Tensor]) -> str:
    """Names of the tensors with infinite or undefined numbers."""
    return ", ".join(name for name, tensor in tensors.items() if not tensor.isfinite().all())


def _copy(tensor: Tensor) -> Tensor:
    return tensor.detach().cpu().clone()
