"""Deployable policies: stacks of deterministic networks with all they need to act on raw frames.

An artifact is a folder of two files: ``policy.json`` (what the policy is: history rule, features,
whether it takes lambda, snapshot steps, format) and ``weights.safetensors`` (numbers, the
normaliser among them). Nothing in it is ever unpickled. The lane axis of a stored policy counts the
snapshots of one training run.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from components.data.normaliser import Normaliser
from components.networks.checkpoint import load_tensors, save_tensors
from components.networks.stacked import StackedMLP

__all__ = ["LAMBDA_MEAN", "LAMBDA_SCALE", "Policy", "PolicyCard", "standardise_lambda"]

FORMAT = "policy/1"
LAMBDA_MEAN = 0.5  # moments of a uniform lambda, as the reference implementation scales its input
LAMBDA_SCALE = 0.2887


def standardise_lambda(proximity: Tensor) -> Tensor:
    """Scale lambda in [0, 1] to the range the networks are fed."""
    return (proximity - LAMBDA_MEAN) / LAMBDA_SCALE


@dataclass(frozen=True, kw_only=True)
class PolicyCard:
    """What a policy artifact is.

    Attributes:
        algorithm: Name of the learner.
        dataset: Name of the dataset it learned from.
        features: Names of a frame's features, in order.
        history: Frames in an observation, newest first; before the start the first one repeats.
        actions: Width of the action, every entry in [-1, 1].
        takes_lambda: Whether the proximity parameter is an input.
        steps: Training step of every stored snapshot, one per lane.
    """

    algorithm: str
    dataset: str
    features: tuple[str, ...]
    history: int
    actions: int
    takes_lambda: bool
    steps: tuple[int, ...]

    @classmethod
    def load(cls, path: Path) -> "PolicyCard":
        """Read ``policy.json``.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is damaged or of another format.
        """
        if not path.is_file():
            raise FileNotFoundError(f"{path.parent} holds no policy ({path.name} is missing).")
        try:
            values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            found = values.pop("format")
            for name in ("features", "steps"):
                values[name] = tuple(values[name])
            if found != FORMAT:
                raise ValueError(f"its format is {found!r} and this version reads {FORMAT!r}")
            return cls(**values)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} cannot be used ({error}); train the policy again.") from error


@dataclass(frozen=True)
class Policy:
    """P deterministic policies ``a = tanh(MLP(normalised history, lambda))`` side by side.

    Attributes:
        card: What they are.
        layers: Weights ``[P, in, out]`` and biases ``[P, 1, out]`` from input to output; ReLU
            between layers.
        frames: Scaling of a frame's features, ``[P, F]``.
    """

    card: PolicyCard
    layers: tuple[tuple[Tensor, Tensor], ...]
    frames: Normaliser

    @classmethod
    def of_network(cls, card: PolicyCard, network: StackedMLP, frames: Normaliser) -> "Policy":
        """Copy a trained stack, one policy per lane."""
        layers = tuple(
            (weight.detach().cpu().clone(), bias.detach().cpu().clone())
            for weight, bias in network.affine()
        )
        scaling = Normaliser(frames.mean.cpu().clone(), frames.scale.cpu().clone())
        return cls(card, layers, scaling)

    @classmethod
    def concatenate(cls, card: PolicyCard, parts: Sequence["Policy"]) -> "Policy":
        """Stack policies of equal shapes under one card."""
        layers = tuple(
            (torch.cat([w for w, _ in group]), torch.cat([b for _, b in group]))
            for group in zip(*(p.layers for p in parts), strict=True)
        )
        mean = torch.cat([p.frames.mean for p in parts])
        scale = torch.cat([p.frames.scale for p in parts])
        return cls(card, layers, Normaliser(mean, scale))

    @property
    def lanes(self) -> int:
        """Number of policies P."""
        return int(self.layers[0][0].shape[0])

    def lane(self, number: int, card: PolicyCard) -> "Policy":
        """One policy of the stack, as a stack of one."""
        keep = slice(number, number + 1)
        layers = tuple((w[keep], b[keep]) for w, b in self.layers)
        return Policy(card, layers, Normaliser(self.frames.mean[keep], self.frames.scale[keep]))

    def to(self, device: torch.device) -> "Policy":
        """The same on another device."""
        layers = tuple((w.to(device), b.to(device)) for w, b in self.layers)
        return Policy(self.card, layers, self.frames.to(device))

    @torch.no_grad()
    def act(self, histories: Tensor, proximity: Tensor | None = None) -> Tensor:
        """Choose actions.

        Args:
            histories: ``[P, B, H, F]`` raw frames, newest first.
            proximity: ``[P, B]`` lambda in [0, 1]; needed exactly if the card says so.

        Returns:
            ``[P, B, A]`` in [-1, 1].

        Raises:
            ValueError: If lambda is missing or not wanted.
        """
        if (proximity is not None) != self.card.takes_lambda:
            wanted = "needs" if self.card.takes_lambda else "does not take"
            raise ValueError(f"A policy of {self.card.algorithm} {wanted} lambda.")
        mean, scale = self.frames.mean[:, None, None], self.frames.scale[:, None, None]
        x = ((histories - mean) / scale).flatten(start_dim=2)
        if proximity is not None:
            x = torch.cat([x, standardise_lambda(proximity)[..., None]], dim=-1)
        for weight, bias in self.layers[:-1]:
            x = torch.baddbmm(bias, x, weight).relu_()
        weight, bias = self.layers[-1]
        return torch.baddbmm(bias, x, weight).tanh_()

    def save(self, folder: Path) -> None:
        """Write the artifact into an existing folder; ``policy.json`` appears last."""
        tensors = {"frame_mean": self.frames.mean, "frame_scale": self.frames.scale}
        for number, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layer{number}.weight": weight, f"layer{number}.bias": bias}
        header = {"format": FORMAT, "layers": len(self.layers)}
        save_tensors(folder / "weights.safetensors", tensors, header)
        temporary = folder / f".policy.json.{os.getpid()}.tmp"
        temporary.write_text(json.dumps({"format": FORMAT, **asdict(self.card)}, indent=2) + "\n")
        os.replace(temporary, folder / "policy.json")

    @classmethod
    def load(cls, folder: Path) -> "Policy":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If the folder holds no policy.
            ValueError: If the files are damaged or of another format.
        """
        card = PolicyCard.load(folder / "policy.json")
        tensors, header = load_tensors(folder / "weights.safetensors")
        try:
            layers = tuple(
                (tensors[f"layer{n}.weight"], tensors[f"layer{n}.bias"])
                for n in range(int(header["layers"]))
            )
            frames = Normaliser(tensors["frame_mean"], tensors["frame_scale"])
        except KeyError as error:
            raise ValueError(
                f"{folder / 'weights.safetensors'} lacks {error}; train the policy again."
            ) from error
        return cls(card, layers, frames)
