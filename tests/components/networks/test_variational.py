"""The autoencoder of actions: its loss by hand, its clamps, and that training improves it."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts.learner import descend
from components.networks.variational import LATENT_CLIP, ConditionalVAE, divergence_from_prior
from components.training.loop import adam
from tests.components.algorithms.plain import floats, network, slopes
from tests.components.synthetic import keys

SEEN, ACTED, BATCH = 3, 2, 4
LATENT = 2 * ACTED
# float32: sums of a few products in another order
CLOSE = {"rel": 1e-4, "abs": 1e-6}


def autoencoder(*names: object, hidden: tuple[int, ...] = (7, 6)) -> ConditionalVAE:
    return ConditionalVAE(keys(*names), SEEN, ACTED, hidden)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def data(lanes: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Observations, actions and noise; some of the noise is far outside the latent clamp."""
    x, actions = normal(lanes, BATCH, SEEN), torch.tanh(normal(lanes, BATCH, ACTED, seed=1))
    return x, actions, 2.0 * normal(lanes, BATCH, LATENT, seed=2)


def divergence_by_formula(mean: float, std: float) -> float:
    return 0.5 * (std**2 + mean**2 - 1.0 - math.log(std**2))


def losses_by_hand(
    made: ConditionalVAE, lane: int, x: Tensor, actions: Tensor, noise: Tensor
) -> tuple[float, float]:
    """Mean squared error and mean divergence, number by number."""
    error = divergence = 0.0
    for i in range(BATCH):
        seen, action = floats(x)[lane, i], floats(actions)[lane, i]
        encoded = network(made.encoder, lane, np.concatenate([seen, action])[None])[0]
        mean, std = encoded[:LATENT], np.exp(np.clip(encoded[LATENT:], -4.0, 15.0))
        latent = mean + std * floats(noise)[lane, i]
        rebuilt = np.tanh(network(made.decoder, lane, np.concatenate([seen, latent])[None])[0])
        for ours, logged in zip(rebuilt, action, strict=True):
            error += (ours - logged) ** 2 / (BATCH * ACTED)
        for m, s in zip(mean, std, strict=True):
            divergence += divergence_by_formula(m, s) / (BATCH * LATENT)
    return error, divergence


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.8, 0.0), (0.0, -1.5), (-1.3, 0.4)])
def test_divergence_equals_formula_and_integral(mean: float, log_std: float) -> None:
    std = math.exp(log_std)
    tensors = [torch.tensor([v], dtype=torch.float64) for v in (mean, log_std)]
    found = divergence_from_prior(*tensors).item()
    assert found == pytest.approx(divergence_by_formula(mean, std), abs=1e-12)  # double
    z = np.linspace(mean - 12.0 * std, mean + 12.0 * std, 20_001)
    log_q = -0.5 * ((z - mean) / std) ** 2 - math.log(std)
    integrand = np.exp(log_q) / math.sqrt(2.0 * math.pi) * (log_q + 0.5 * z**2)
    # the trapezoid rule is exact to rounding for functions that vanish at both ends
    assert found == pytest.approx(np.trapezoid(integrand, z), abs=1e-9)


def test_divergence_is_per_dimension() -> None:
    found = divergence_from_prior(torch.tensor([[0.0, 2.0]]), torch.zeros(1, 2))
    assert found.tolist() == [[0.0, 2.0]]


def test_losses_by_hand() -> None:
    made = autoencoder("a", "b")
    x, actions, noise = data()
    loss, error, divergence = made.losses(x, actions, noise)
    for lane in range(2):
        squares, apart = losses_by_hand(made, lane, x, actions, noise)
        assert error[lane].item() == pytest.approx(squares, **CLOSE)
        assert divergence[lane].item() == pytest.approx(apart, **CLOSE)
        assert loss[lane].item() == pytest.approx(squares + 0.5 * apart, **CLOSE)


def test_latents_carry_gradients_to_the_encoder() -> None:
    made = autoencoder("a").double()
    x, actions, noise = (t.double() for t in data(1))
    _, bias = made.encoder.affine()[-1]
    _, error, _ = made.losses(x, actions, noise)
    (gradient,) = torch.autograd.grad(error.sum(), bias)
    expected = slopes(lambda: losses_by_hand(made, 0, x, actions, noise)[0], bias.data[0, 0])
    assert min(abs(slope) for slope in expected) > 1e-5
    # central differences in double: 1e-10 from the step, 1e-11 from rounding
    assert gradient[0, 0].tolist() == pytest.approx(expected, abs=1e-8)


def test_log_deviation_of_latents_is_clamped() -> None:
    made = ConditionalVAE(keys("a"), SEEN, 3, ())
    weight, bias = made.encoder.affine()[-1]
    spread = [-100.0, -4.5, -3.5, 14.5, 15.5, 100.0]
    with torch.no_grad():
        weight.zero_()
        bias[0, 0] = torch.tensor([9.0] * 6 + spread)
    mean, log_std = made.encode(torch.ones(1, 1, SEEN), torch.ones(1, 1, 3))
    assert mean[0, 0].tolist() == [9.0] * 6
    assert log_std[0, 0].tolist() == [-4.0, -4.0, -3.5, 14.5, 15.0, 15.0]


def test_generated_actions_come_from_clamped_latents() -> None:
    made = autoencoder("a", "b")
    x, noise = normal(2, BATCH, SEEN), 2.0 * normal(2, BATCH, 5, LATENT, seed=3)
    raw = made.generate(x, noise)
    assert raw.shape == (2, BATCH, 5, ACTED)
    assert LATENT_CLIP == 0.5
    for lane, i, n in np.ndindex(2, BATCH, 5):
        latent = [min(max(z, -0.5), 0.5) for z in floats(noise)[lane, i, n]]
        inputs = np.concatenate([floats(x)[lane, i], latent])[None]
        expected = network(made.decoder, lane, inputs)[0]  # no tanh
        assert raw[lane, i, n].tolist() == pytest.approx(expected.tolist(), **CLOSE)


def test_latents_of_training_are_not_clamped() -> None:
    made = autoencoder("a")
    with torch.no_grad():
        for parameter in made.encoder.parameters():
            parameter.zero_()  # latents are the noise itself
        for parameter in made.decoder.parameters():
            parameter.mul_(2.0)  # and the decoder hears them
    x, actions, noise = data(1)
    assert (noise.abs() > 1.0).any()
    whole = made.losses(x, actions, noise)[1].item()
    clamped = made.losses(x, actions, noise.clamp(-LATENT_CLIP, LATENT_CLIP))[1].item()
    assert whole == pytest.approx(losses_by_hand(made, 0, x, actions, noise)[0], **CLOSE)
    assert abs(whole - clamped) > 1e-3


def test_lanes_are_independent() -> None:
    made, alone = autoencoder("a", "b"), autoencoder("b")
    for many, one in zip(made.parameters(), alone.parameters(), strict=True):
        assert torch.equal(many[1:], one)
    x, actions, noise = data()
    made.losses(x, actions, noise)[0][0].backward()
    for parameter in made.parameters():
        assert parameter.grad[0].any()
        assert not parameter.grad[1].any()


def test_training_rebuilds_what_observations_tell_and_what_they_do_not() -> None:
    made = autoencoder("a", hidden=(16,))
    optimizer = adam(list(made.parameters()), 1e-2)
    x = normal(1, 128, SEEN)
    coin = normal(1, 128, 1, seed=1).sign()
    actions = torch.cat([torch.tanh(2.0 * x[..., :1] - x[..., 1:2]), 0.8 * coin], dim=-1)
    errors, divergences = [], []
    for step in range(250):
        loss, error, divergence = made.losses(x, actions, normal(1, 128, LATENT, seed=step))
        descend(optimizer, loss)
        errors.append(error.item())
        divergences.append(divergence.item())
    # five initialisations measured: 0.66 to 0.78 at first, 0.031 to 0.037 over the last 20 updates
    assert errors[0] > 0.5
    assert np.mean(errors[-20:]) < 0.08
    # one coin costs log 2 spread over the latents, 0.173; measured 0.180 to 0.190
    assert 0.15 < np.mean(divergences[-20:]) < 0.25
    generated = torch.tanh(made.generate(x, normal(1, 128, 1, LATENT, seed=2)))[0, :, 0]
    # measured 0.0012 to 0.0017
    assert (generated - actions[0])[:, 0].square().mean() < 0.01
    # the coin is tossed anew and falls on both sides; measured deviations 0.54 to 0.60
    assert generated[:, 1].std() > 0.4
