"""Conditional variational autoencoders of actions, on stacked lanes.

The generative model of logged actions in BCQ, BEAR and MOOSE: ``z ~ N(0, 1)``,
``a = tanh(D(s, z))``, with the encoder ``q(z | s, a) = N(mean, std^2)``. Fujimoto, Meger, Precup,
"Off-Policy Deep Reinforcement Learning without Exploration" (2019), with the weighting of the
authors' code: mean squared error plus half the KL divergence, both averaged over batch and
dimensions.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import hardtanh, mse_loss

from components.core.random_streams import spawn_generators
from components.networks.stacked import StackedMLP, lanewise_mean

__all__ = ["LATENT_CLIP", "ConditionalVAE", "divergence_from_prior"]

LATENT_CLIP = 0.5  # latents are clamped to +-0.5 when actions are generated, not in training
_LOG_STD_RANGE = (-4.0, 15.0)
_DIVERGENCE_WEIGHT = 0.5


def divergence_from_prior(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL(N(mean, std^2) || N(0, 1)) per dimension."""
    return 0.5 * (mean.square() + (2.0 * log_std).exp() - 1.0) - log_std


class ConditionalVAE(nn.Module):
    """L conditional autoencoders side by side.

    Args:
        keys: One random stream per lane.
        observations: Width O.
        actions: Width A; the latent width is Z = 2 A.
        hidden: Layer widths of encoder and decoder.
    """

    def __init__(
        self, keys: Sequence[int], observations: int, actions: int, hidden: Sequence[int]
    ) -> None:
        super().__init__()
        self.latent = 2 * actions
        self.encoder = StackedMLP(
            spawn_generators(keys, "encoder"), (observations + actions, *hidden, 2 * self.latent)
        )
        self.decoder = StackedMLP(
            spawn_generators(keys, "decoder"), (observations + self.latent, *hidden, actions)
        )

    def encode(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation ``[L, B, Z]`` of the latents of actions ``[L, B, A]``."""
        encoded = self.encoder(torch.cat([observations, actions], dim=-1))
        mean, log_std = encoded.chunk(2, dim=-1)
        return mean, hardtanh(log_std, *_LOG_STD_RANGE)

    def generate(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Actions before the tanh ``[L, B, N, A]`` from normal ``noise [L, B, N, Z]``."""
        return self.decoder.over_actions(observations, noise.clamp(-LATENT_CLIP, LATENT_CLIP))

    def reconstruct(
        self, observations: Tensor, actions: Tensor, noise: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Actions ``[L, B, A]`` decoded from one sample of their latents, and its distribution.

        Args:
            observations: ``[L, B, O]``.
            actions: ``[L, B, A]``.
            noise: Standard normal ``[L, B, Z]``; 0 decodes the mean.
        """
        mean, log_std = self.encode(observations, actions)
        latent = torch.addcmul(mean, log_std.exp(), noise)
        rebuilt = torch.tanh(self.decoder(torch.cat([observations, latent], dim=-1)))
        return rebuilt, (mean, log_std)

    def losses(
        self, observations: Tensor, actions: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Training loss, squared reconstruction error and divergence, ``[L]`` each.

        Args:
            observations: ``[L, B, O]``.
            actions: ``[L, B, A]``.
            noise: Standard normal ``[L, B, Z]``.
        """
        rebuilt, latents = self.reconstruct(observations, actions, noise)
        error = lanewise_mean(mse_loss(rebuilt, actions, reduction="none"))
        divergence = lanewise_mean(divergence_from_prior(*latents))
        return error + _DIVERGENCE_WEIGHT * divergence, error, divergence
