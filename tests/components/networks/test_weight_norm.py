"""Weight normalisation: the same functions, other coordinates."""

import numpy as np
import pytest
import torch

from components.core.random_streams import spawn_generators
from components.networks import StackedMLP
from components.networks.weight_norm import WeightNormMLP
from tests.components.synthetic import keys

SIZES = (5, 7, 6, 2)
X = torch.randn(3, 11, 5, generator=torch.Generator().manual_seed(0))


def stack(kind: type) -> StackedMLP | WeightNormMLP:
    return kind(spawn_generators(keys(0, 1, 2), "weights"), SIZES)


def moved() -> WeightNormMLP:
    """A network whose lengths are no longer those of its directions."""
    network = stack(WeightNormMLP)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for length in network.lengths:
            length.mul_(torch.rand(length.shape, generator=generator) * 3.0 - 1.0)
    return network


def test_at_the_start_it_is_the_plain_network() -> None:
    plain, normalised = stack(StackedMLP), stack(WeightNormMLP)
    for (weight, bias), (w, b) in zip(plain.affine(), normalised.affine(), strict=True):
        torch.testing.assert_close(w, weight)  # a length divided by itself, in float32
        assert torch.equal(b, bias)
    torch.testing.assert_close(normalised(X), plain(X))


def test_folded_weights_by_hand() -> None:
    network = moved()
    x = X.double().numpy()
    for number, (weight, bias) in enumerate(network.affine()):
        v = network.directions[number].detach().double().numpy()
        g = network.lengths[number].detach().double().numpy()
        by_hand = v * (g / np.sqrt(np.square(v).sum(axis=1, keepdims=True)))
        np.testing.assert_allclose(weight.detach().numpy(), by_hand, rtol=1e-5)  # float32
        x = np.maximum(x, 0.0) if number else x
        x = np.einsum("lbi,lio->lbo", x, by_hand) + bias.detach().double().numpy()
    # float32 sums of seven products, layer by layer
    np.testing.assert_allclose(network(X).detach().numpy(), x, rtol=1e-4, atol=1e-5)


def test_folded_weights_make_the_plain_network() -> None:
    normalised, plain = moved(), stack(StackedMLP)
    with torch.no_grad():
        for (weight, bias), (w, b) in zip(plain.affine(), normalised.affine(), strict=True):
            weight.copy_(w)
            bias.copy_(b)
    assert torch.equal(plain(X), normalised(X))


def test_lengths_and_directions_are_learned_apart() -> None:
    """A unit's direction is not moved along itself: its gradient is orthogonal to it."""
    network = moved()
    network(X).square().mean(dim=(1, 2)).sum().backward()
    for v, g in zip(network.directions, network.lengths, strict=True):
        along = (v.grad * v).detach().sum(dim=1)
        size = v.grad.norm(dim=1) * v.detach().norm(dim=1)
        assert g.grad.abs().max() > 0
        # a cancellation of seven float32 products
        assert float((along.abs() / size.clamp(min=1e-12)).max()) == pytest.approx(0.0, abs=1e-4)


def test_lanes_learn_as_alone() -> None:
    together = stack(WeightNormMLP)
    alone = WeightNormMLP(spawn_generators(keys(1), "weights"), SIZES)
    for network, x in ((together, X), (alone, X[1:2])):
        optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
        for _ in range(20):
            optimizer.zero_grad()
            network(x).square().mean(dim=(1, 2)).sum().backward()
            optimizer.step()
    for (weight, _), (w, _) in zip(together.affine(), alone.affine(), strict=True):
        # twenty Adam updates in float32; stacking may change the order of sums
        torch.testing.assert_close(weight[1:2], w, rtol=1e-3, atol=1e-5)
