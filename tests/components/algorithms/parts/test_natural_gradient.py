"""Conjugate gradients, Fisher matrices and steps against explicit matrices in double precision."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts.natural_gradient import (
    FisherProduct,
    GaussianPolicy,
    conjugate_gradients,
    natural_step,
    policy_gradient,
)
from tests.components.algorithms.plain import floats
from tests.components.synthetic import keys

SEEN, HIDDEN, ACTED, BATCH = 4, 3, 2, 6
SIZE = SEEN * HIDDEN + HIDDEN + HIDDEN * ACTED + ACTED + ACTED  # parameters of one policy


def small_policy(*names: object, log_std: float = -0.4) -> GaussianPolicy:
    """Policies in double precision whose means and deviations differ between lanes and entries."""
    policy = GaussianPolicy(keys(*names), (SEEN, HIDDEN, ACTED), log_std).double()
    generator = torch.Generator().manual_seed(len(names))
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.4 * torch.randn(parameter.shape, generator=generator).double())
    return policy


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).double()


def row(policy: GaussianPolicy, lane: int) -> Tensor:
    """One lane's parameters in a row: layer by layer, the deviations last."""
    parts = [p.detach()[lane].flatten() for p in policy.stack.parameters()]
    return torch.cat([*parts, policy.log_std.detach()[lane].flatten()])


def parts(vector: Tensor) -> tuple[Tensor, ...]:
    """The same cut into weights, biases and log deviations."""
    shapes = [(SEEN, HIDDEN), (HIDDEN,), (HIDDEN, ACTED), (ACTED,), (ACTED,)]
    cut = vector.split([math.prod(shape) for shape in shapes])
    return tuple(part.reshape(shape) for part, shape in zip(cut, shapes, strict=True))


def gaussian(vector: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Means ``[N, A]`` and deviations ``[A]``."""
    weight, bias, last_weight, last_bias, log_std = parts(vector)
    return torch.tanh(seen @ weight + bias) @ last_weight + last_bias, log_std.exp()


def divergence(vector: Tensor, old: Tensor, seen: Tensor) -> Tensor:
    """Mean KL(old || new) of the Gaussians at ``seen [N, O]``."""
    (mean, std), (old_mean, old_std) = gaussian(vector, seen), gaussian(old, seen)
    ratio = (old_std**2 + (old_mean - mean) ** 2) / (2.0 * std**2)
    return (torch.log(std / old_std) + ratio - 0.5).sum(dim=1).mean()


def hessian(policy: GaussianPolicy, lane: int, seen: Tensor) -> np.ndarray:
    """Of that divergence at the policy itself, entry by entry by automatic differentiation."""
    old = row(policy, lane)
    found = torch.autograd.functional.hessian(lambda v: divergence(v, old, seen), old.clone())
    return found.numpy()


def definite(lanes: int, size: int) -> Tensor:
    matrix = drawn(lanes, size, size, seed=1)
    return matrix @ matrix.transpose(1, 2) + torch.eye(size)


def by(matrices: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda vector: torch.einsum("lij,lj->li", matrices, vector)


def test_conjugate_gradients_solve_every_lanes_system() -> None:
    matrices, targets = definite(3, 7), drawn(3, 7, seed=2)
    targets[1] *= 1e6
    found = conjugate_gradients(by(matrices), targets, 30, tolerance=1e-24)
    for lane in range(3):
        expected = np.linalg.solve(matrices[lane].numpy(), targets[lane].numpy())
        # residuals of 1e-12 of the target, times condition numbers up to a hundred
        np.testing.assert_allclose(
            found[lane], expected, rtol=1e-8, atol=1e-9 * abs(expected).max()
        )


def test_an_iterate_is_the_best_of_its_krylov_space() -> None:
    matrices, targets = definite(2, 7), drawn(2, 7, seed=2)
    for iterations in (1, 3):
        found = conjugate_gradients(by(matrices), targets, iterations)
        for lane in range(2):
            a, b = matrices[lane].numpy(), targets[lane].numpy()
            space = np.stack([np.linalg.matrix_power(a, k) @ b for k in range(iterations)], axis=1)
            best = space @ np.linalg.solve(space.T @ a @ space, space.T @ b)
            # double precision; powers of a matrix lose a few digits
            np.testing.assert_allclose(found[lane], best, rtol=1e-8)


def test_lanes_do_not_feel_each_other_and_empty_ones_rest() -> None:
    matrices, targets = definite(3, 5), drawn(3, 5, seed=3)
    targets[1] = 0.0
    matrices[2] = torch.eye(5)  # solved after one iteration, asked for twenty
    together = conjugate_gradients(by(matrices), targets, 20)
    assert torch.equal(together[1], torch.zeros(5).double())
    # one division and one product each way
    torch.testing.assert_close(together[2], targets[2], rtol=1e-14, atol=0.0)
    for lane in range(3):
        own = slice(lane, lane + 1)
        alone = conjugate_gradients(by(matrices[own]), targets[own], 20)
        # sums of five numbers in double precision, perhaps in another order
        torch.testing.assert_close(together[own], alone, rtol=1e-12, atol=1e-14)


def test_fisher_product_is_the_hessian_of_the_divergence() -> None:
    policy, seen = small_policy("a", "b"), drawn(2, BATCH, SEEN)
    product = FisherProduct(policy, seen)
    for lane in range(2):
        expected = hessian(policy, lane, seen[lane])
        assert np.abs(expected[:SEEN, :SEEN]).max() > 1e-3, "the inner layer must matter"
        for entry in range(SIZE):
            vector = torch.zeros(2, SIZE).double()
            vector[lane, entry] = 1.0
            found = product(vector)
            np.testing.assert_allclose(found[lane], expected[entry], atol=1e-12)  # double
            assert torch.equal(found[1 - lane], torch.zeros(SIZE).double())


@pytest.mark.parametrize("iterations", [1, 3, 60])
def test_a_step_has_its_quadratic_divergence_however_early_the_iteration_ends(
    iterations: int,
) -> None:
    policy, seen, gradient = small_policy("a", "b"), drawn(2, BATCH, SEEN), drawn(2, SIZE, seed=5)
    step = natural_step(
        FisherProduct(policy, seen), gradient, size=0.02, damping=0.1, iterations=iterations
    )
    for lane in range(2):
        matrix = hessian(policy, lane, seen[lane]) + 0.1 * np.eye(SIZE)
        quadratic = 0.5 * floats(step)[lane] @ matrix @ floats(step)[lane]
        assert quadratic == pytest.approx(0.01, rel=1e-8)  # double precision
        if iterations == 60:
            ascent = np.linalg.solve(matrix, floats(gradient)[lane])
            cosine = ascent @ floats(step)[lane] / np.linalg.norm(ascent)
            # solved to the iteration's own tolerance, 1e-5 of the gradient
            assert cosine == pytest.approx(np.linalg.norm(floats(step)[lane]), rel=1e-6)


def test_a_small_step_has_that_divergence_in_truth() -> None:
    policy, seen = small_policy("a"), drawn(1, BATCH, SEEN)
    # A policy's own gradient lies in the span of the Fisher matrix, whose rank is far below 25.
    samples = (seen, drawn(1, BATCH, ACTED, seed=6), drawn(1, BATCH, seed=7))
    step = natural_step(
        FisherProduct(policy, seen),
        policy_gradient(policy, [samples]),
        size=2e-6,
        damping=1e-6,
        iterations=60,
    )
    old = row(policy, 0)
    true = float(divergence(old + step[0], old, seen[0]))
    # cubic terms of a step of about 1e-3, and the damping's share
    assert true == pytest.approx(1e-6, rel=0.05)


def test_the_gradients_scale_does_not_matter_and_none_moves_nothing() -> None:
    policy, seen = small_policy("a", "b", "c"), drawn(3, BATCH, SEEN)
    gradient = drawn(1, SIZE, seed=5).repeat(3, 1) * torch.tensor([[1.0], [1e4], [0.0]])
    product = FisherProduct(policy, seen)
    settings = {"size": 0.02, "damping": 0.1, "iterations": 20}
    step = natural_step(product, gradient, **settings)
    louder = natural_step(product, 1024.0 * gradient, **settings)
    # a power of two only moves exponents; one rounding where the square root meets the direction
    torch.testing.assert_close(louder, step, rtol=1e-14, atol=0.0)
    assert torch.equal(step[2], torch.zeros(SIZE).double())


def test_policy_gradient_is_the_slope_of_the_weighted_log_densities() -> None:
    policy, seen = small_policy("a", "b"), drawn(2, BATCH, SEEN)
    noise, weights = drawn(2, BATCH, ACTED, seed=6), drawn(2, BATCH, seed=7)
    portions = [(seen[:, n], noise[:, n], weights[:, n]) for n in (slice(0, 4), slice(4, 6))]
    found = policy_gradient(policy, portions)
    for lane in range(2):
        vector = row(policy, lane)
        mean, std = gaussian(vector, seen[lane])
        actions = mean + std * noise[lane]

        def objective(moved: Tensor, actions: Tensor = actions, lane: int = lane) -> float:
            mean, std = gaussian(moved, seen[lane])
            total = 0.0
            for n in range(BATCH):
                for d in range(ACTED):
                    u, m, s = (float(x) for x in (actions[n, d], mean[n, d], std[d]))
                    density = math.exp(-0.5 * ((u - m) / s) ** 2) / (s * math.sqrt(2 * math.pi))
                    total += float(weights[lane, n]) * math.log(density)
            return total

        for entry in range(SIZE):
            ends = []
            for shift in (1e-6, -1e-6):
                moved = vector.clone()
                moved[entry] += shift
                ends.append(objective(moved))
            slope = (ends[0] - ends[1]) / 2e-6
            # central differences in double precision
            assert found[lane, entry].item() == pytest.approx(slope, rel=1e-6, abs=1e-7)


def test_a_gradient_needs_samples() -> None:
    with pytest.raises(ValueError, match="needs samples"):
        policy_gradient(small_policy("a"), [])


def test_advancing_adds_the_step_and_keeps_the_deviations_in_range() -> None:
    policy = small_policy("a", "b")
    before = [row(policy, lane) for lane in range(2)]
    step = 0.1 * drawn(2, SIZE, seed=8)
    step[0, -1], step[1, -2] = 9.0, -9.0
    policy.advance(step)
    for lane in range(2):
        expected = before[lane] + step[lane]
        expected[-ACTED:] = expected[-ACTED:].clamp(-2.0, 1.0)
        assert torch.equal(row(policy, lane), expected)
    assert row(policy, 0)[-1] == 1.0
    assert row(policy, 1)[-2] == -2.0


def test_means_are_small_at_first() -> None:
    policy = GaussianPolicy(keys("a"), (SEEN, 64, ACTED), -0.25)
    mean = policy(drawn(1, 50, SEEN).float())
    # weights and biases below 1/8, times 0.01 and at most 65 of them
    assert 0.0 < mean.abs().max() < 0.01 * 65 / 8
    assert torch.equal(policy.log_std, torch.full((1, 1, ACTED), -0.25))


def test_it_ascends_to_the_known_optimum_of_a_bandit() -> None:
    """The best action at ``s`` is ``0.5 s - 0.2``; the second lane's rewards are a thousandth."""
    policy = GaussianPolicy(keys("a", "b"), (1, 16, 1), -0.25)
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([[1.0], [1e-3]])
    for _ in range(50):
        seen = 2.0 * torch.rand(2, 500, 1, generator=generator) - 1.0
        noise = torch.randn(2, 500, 1, generator=generator)
        with torch.no_grad():
            actions = policy.draw(seen, noise)
        rewards = -(actions - 0.5 * seen + 0.2).square().squeeze(-1) * scale
        advantages = (rewards - rewards.mean(dim=1, keepdim=True)) / 500
        gradient = policy_gradient(policy, [(seen, noise, advantages)])
        policy.advance(
            natural_step(
                FisherProduct(policy, seen), gradient, size=0.02, damping=1e-3, iterations=10
            )
        )
    states = torch.linspace(-1.0, 1.0, 21).expand(2, -1)[..., None]
    error = (policy(states) - (0.5 * states - 0.2)).detach().abs().mean(dim=(1, 2))
    # 0.27 where the mean action is 0 everywhere; measured at most 0.03 with five seeds
    assert error.max() < 0.1
    assert policy.log_std.max() < -1.0, "noise costs, so it must have become less"
