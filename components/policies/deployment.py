"""How deployed policies act, by name: from networks, observations and noise to actions.

Deterministic policies are one network. BCQ and BEAR draw candidates at every state and let a critic
choose; the first layer's product with the observation is computed once for all of them.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor

from components.networks.gaussian import LOG_STD_RANGE
from components.networks.stacked import Activation, first_layer_over_actions
from components.networks.variational import LATENT_CLIP

__all__ = ["KINDS", "Layers", "critic_values"]

Layers = tuple[tuple[Tensor, Tensor], ...]
"""Weights ``[P, in, out]`` and biases ``[P, 1, out]`` from input to output; the activation between
them is ReLU where the kind does not say otherwise."""

Networks = Mapping[str, Layers]
Act = Callable[[Networks, Tensor, Tensor | None, float], Tensor]


def _apply(layers: Layers, x: Tensor, activation: Activation = torch.relu_) -> Tensor:
    for weight, bias in layers[:-1]:
        x = activation(torch.baddbmm(bias, x, weight))
    weight, bias = layers[-1]
    return torch.baddbmm(bias, x, weight)


def _apply_over(layers: Layers, x: Tensor, extra: Tensor) -> Tensor:
    """A network on ``x [P, B, O]`` joined with each of ``extra [P, B, N, E]``."""
    x = first_layer_over_actions(*layers[0], x, extra)
    if len(layers) > 1:
        x = _apply(layers[1:], x.relu_())
    return x.view(*extra.shape[:3], -1)


def _best_candidate(critic: Layers, x: Tensor, candidates: Tensor) -> Tensor:
    """The candidate ``[P, B, A]`` of greatest value among ``[P, B, N, A]``."""
    values = _apply_over(critic, x, candidates).squeeze(-1)
    best = values.nan_to_num(nan=-torch.inf).argmax(dim=-1)[..., None, None]
    return candidates.gather(2, best.expand(-1, -1, 1, candidates.shape[-1])).squeeze(2)


def critic_values(networks: Networks, x: Tensor, actions: Tensor) -> Tensor:
    """Values ``[P, B]`` of actions ``[P, B, A]``, as those that choose candidates see them."""
    return _apply_over(networks["critic"], x, actions[:, :, None])[..., 0, 0]


def _tanh(networks: Networks, x: Tensor, noise: Tensor | None, perturbation: float) -> Tensor:
    return _apply(networks["actor"], x).tanh_()


def _clipped(networks: Networks, x: Tensor, noise: Tensor | None, perturbation: float) -> Tensor:
    return _apply(networks["actor"], x).clamp_(-1.0, 1.0)


def _clipped_tanh_layers(
    networks: Networks, x: Tensor, noise: Tensor | None, perturbation: float
) -> Tensor:
    return _apply(networks["actor"], x, torch.tanh_).clamp_(-1.0, 1.0)


def _gaussian(networks: Networks, x: Tensor, noise: Tensor, perturbation: float) -> Tensor:
    mean, log_std = _apply(networks["actor"], x).chunk(2, dim=-1)
    std = log_std.clamp(*LOG_STD_RANGE).exp()
    candidates = torch.tanh(mean[:, :, None] + std[:, :, None] * noise)
    return _best_candidate(networks["critic"], x, candidates)


def _perturbed(networks: Networks, x: Tensor, noise: Tensor, perturbation: float) -> Tensor:
    latent = noise.clamp(-LATENT_CLIP, LATENT_CLIP)
    generated = _apply_over(networks["decoder"], x, latent).tanh_()
    shift = _apply_over(networks["actor"], x, generated).tanh_().mul_(perturbation)
    return _best_candidate(networks["critic"], x, (generated + shift).clamp_(-1.0, 1.0))


def _one_by_one(act: Callable[[Networks, Tensor, Tensor, float], Tensor]) -> Act:
    """Run one policy after the other: candidates of all at once would need too much memory."""

    def each(networks: Networks, x: Tensor, noise: Tensor | None, perturbation: float) -> Tensor:
        if noise is None:
            raise ValueError("Candidates are drawn from noise; give it.")
        chosen = []
        for n in range(len(x)):
            lane = slice(n, n + 1)
            alone = {
                role: tuple((weight[lane], bias[lane]) for weight, bias in layers)
                for role, layers in networks.items()
            }
            chosen.append(act(alone, x[lane], noise[lane], perturbation))
        return torch.cat(chosen)

    return each


KINDS: Final[Mapping[str, Act]] = MappingProxyType(
    {
        "tanh": _tanh,
        "clipped": _clipped,
        "clipped_tanh_layers": _clipped_tanh_layers,
        "gaussian_candidates": _one_by_one(_gaussian),
        "perturbed_candidates": _one_by_one(_perturbed),
    }
)
"""``act(networks, x [P, B, O], noise [P, B, N, E] or None, perturbation) -> [P, B, A]``.

- ``tanh``: the tanh of the actor's output.
- ``clipped``: the actor's output clipped to [-1, 1].
- ``clipped_tanh_layers``: the same with tanh between the actor's layers (MOReL).
- ``gaussian_candidates``: the action of greatest critic value among N actions of a squashed
  Gaussian actor (BEAR).
- ``perturbed_candidates``: the same among N decoded actions, each shifted by the actor (BCQ).
"""
