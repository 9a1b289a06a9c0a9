"""Squashed Gaussians: densities against textbook formulas, and at the ends of the action box."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.networks import TanhGaussian
from components.networks.gaussian import LOG_STD_RANGE, log_density, raw_actions
from components.policies.policy import Policy
from tests.components.algorithms.plain import floats, network
from tests.components.synthetic import FEATURES, keys, policy_card


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def by_formula(mean: list[float], log_std: list[float], raw: list[float]) -> float:
    """log N(u; m, s^2) - log(1 - tanh(u)^2), summed over dimensions."""
    total = 0.0
    for m, log_s, u in zip(mean, log_std, raw, strict=True):
        s = math.exp(log_s)
        total += math.log(math.exp(-0.5 * ((u - m) / s) ** 2) / (s * math.sqrt(2.0 * math.pi)))
        total -= math.log(1.0 - math.tanh(u) ** 2)
    return total


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, -1.0), (0.7, -0.5), (-1.2, 0.0), (0.3, -3.0)])
def test_density_integrates_to_one(mean: float, log_std: float) -> None:
    cells = 200_000
    actions = -1.0 + (torch.arange(cells, dtype=torch.float64) + 0.5) * 2.0 / cells
    centre, spread = (torch.tensor([v], dtype=torch.float64) for v in (mean, log_std))
    density = log_density(centre, spread, torch.atanh(actions)[:, None]).exp()
    # midpoint rule; the outermost cells hold less than 1e-6 of the mass
    assert (density.sum() * 2.0 / cells).item() == pytest.approx(1.0, abs=1e-5)


def test_density_equals_the_formula_summed_over_dimensions() -> None:
    mean, log_std, raw = normal(6, 3), 0.5 * normal(6, 3, seed=1), normal(6, 3, seed=2)
    densities = log_density(mean, log_std, raw)
    assert densities.shape == (6,)
    for i in range(6):
        expected = by_formula(mean[i].tolist(), log_std[i].tolist(), raw[i].tolist())
        assert densities[i].item() == pytest.approx(expected, abs=1e-4)  # float32, values of ~10


@pytest.mark.parametrize("margin", [1e-3, 1e-6])
def test_actions_on_the_bounds_have_finite_densities(margin: float) -> None:
    actions = torch.tensor([-1.0, 1.0, 0.5, -0.25])
    raw = raw_actions(actions, margin)
    far = 0.5 * math.log((2.0 - margin) / margin)
    expected = [-far, far, 0.5 * math.log(3.0), 0.5 * math.log(0.75 / 1.25)]
    # float32 knows 1 - margin to 3e-8, so the inverse tanh to 3e-8 / (2 margin)
    assert raw.tolist() == pytest.approx(expected, abs=1e-6 + 2e-8 / margin)
    assert log_density(torch.zeros(4, 1), torch.full((4, 1), -5.0), raw[:, None]).isfinite().all()


def test_raw_actions_invert_the_tanh() -> None:
    raw = torch.linspace(-3.0, 3.0, 13)
    # tanh(3) = 0.995, where float32's 3e-8 become 3e-6
    torch.testing.assert_close(raw_actions(torch.tanh(raw), 1e-3), raw, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("far", [-40.0, 40.0])
def test_far_samples_neither_overflow_nor_lose_their_gradient(far: float) -> None:
    mean, log_std, raw = (torch.tensor([v], requires_grad=True) for v in (0.0, 0.0, far))
    density = log_density(mean, log_std, raw)
    # 1 - tanh(u)^2 is 4 exp(-2 |u|) here, which float32 would round to 0
    expected = -0.5 * 40.0**2 - 0.5 * math.log(2.0 * math.pi) - (math.log(4.0) - 80.0)
    assert density.item() == pytest.approx(expected, rel=1e-6)  # one rounding in float32
    slopes = torch.autograd.grad(density, [mean, log_std, raw])
    # (u - m) / s^2, ((u - m) / s)^2 - 1, and -(u - m) / s^2 + 2 tanh(u)
    sign = math.copysign(1.0, far)
    assert [s.item() for s in slopes] == pytest.approx([far, 1599.0, -far + 2.0 * sign], rel=1e-6)


def spread_by(spreads: list[float], **settings: object) -> tuple[Tensor, Tensor]:
    """Mean and log deviation of a policy without hidden layers that ignores what it sees."""
    made = TanhGaussian(keys("a"), "actor", (2, len(spreads)), **settings)
    (weight, bias) = made.stack.affine()[0]
    with torch.no_grad():
        weight.zero_()
        bias[0, 0] = torch.tensor([7.0] * len(spreads) + spreads)
        mean, log_std = made(torch.ones(1, 1, 2))
    assert mean.tolist() == [[[7.0] * len(spreads)]]
    return mean, log_std


def test_log_deviation_is_clamped() -> None:
    assert LOG_STD_RANGE == (-5.0, 2.0)
    raw = [-100.0, -5.5, -4.5, 0.0, 1.5, 2.5, 100.0]
    _, log_std = spread_by(raw)
    assert log_std[0, 0].tolist() == [-5.0, -5.0, -4.5, 0.0, 1.5, 2.0, 2.0]
    _, log_std = spread_by([-2.0, 0.0, 2.0], log_std_range=(-1.0, 0.5))
    assert log_std[0, 0].tolist() == [-1.0, 0.0, 0.5]


def test_log_deviation_is_squashed() -> None:
    raw = [-100.0, -0.5, 0.0, 1.0, 100.0]
    _, log_std = spread_by(raw, squash=True)
    expected = [-5.0 + 3.5 * (math.tanh(v) + 1.0) for v in raw]
    assert expected[0] == -5.0
    assert expected[2] == -1.5
    assert expected[4] == 2.0
    assert log_std[0, 0].tolist() == pytest.approx(expected, abs=1e-6)  # float32
    _, log_std = spread_by(raw, squash=True, log_std_range=(-3.0, 1.0))
    assert log_std[0, 0].tolist()[2:] == pytest.approx([-1.0, -1.0 + 2.0 * math.tanh(1.0), 1.0])


def test_lanes_are_plain_networks_whose_weights_depend_on_their_key_and_purpose() -> None:
    made = TanhGaussian(keys("a", "b"), "actor", (4, 7, 3))
    x = normal(2, 5, 4)
    mean, log_std = made(x)
    for lane in range(2):
        out = network(made.stack, lane, floats(x)[lane])
        # float32 sums of seven products; untrained spreads lie inside the clamp
        np.testing.assert_allclose(floats(mean)[lane], out[:, :3], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(floats(log_std)[lane], out[:, 3:], rtol=1e-4, atol=1e-5)
    alone = TanhGaussian(keys("b"), "actor", (4, 7, 3))
    other = TanhGaussian(keys("b"), "other", (4, 7, 3))
    for many, same, different in zip(
        made.parameters(), alone.parameters(), other.parameters(), strict=True
    ):
        assert torch.equal(many[1:], same)
        assert not torch.equal(same, different)


def test_samples_are_drawn_by_reparameterisation() -> None:
    mean, log_std = normal(2, 3, 2), 0.5 * normal(2, 3, 2, seed=1) - 1.0
    noise = normal(2, 3, 4, 2, seed=2)
    actions, raw, densities = TanhGaussian.draw((mean, log_std), noise)
    assert actions.shape == raw.shape == (2, 3, 4, 2)
    assert densities.shape == (2, 3, 4)
    for place in np.ndindex(2, 3, 4):
        m, s = floats(mean)[place[:2]], floats(log_std)[place[:2]]
        u = m + np.exp(s) * floats(noise)[place]
        # float32
        np.testing.assert_allclose(floats(raw)[place], u, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(floats(actions)[place], np.tanh(u), rtol=1e-5, atol=1e-6)
        expected = by_formula(m.tolist(), s.tolist(), u.tolist())
        assert densities[place].item() == pytest.approx(expected, abs=1e-4)


def test_samples_carry_gradients_to_mean_and_deviation() -> None:
    mean = torch.tensor([[[0.4]]], requires_grad=True)
    log_std = torch.tensor([[[-0.7]]], requires_grad=True)
    actions, _, densities = TanhGaussian.draw((mean, log_std), torch.tensor([[[[1.5]]]]))
    std = math.exp(-0.7)
    u = 0.4 + 1.5 * std
    slope = 1.0 - math.tanh(u) ** 2
    of_action = torch.autograd.grad(actions.sum(), [mean, log_std], retain_graph=True)
    assert [g.item() for g in of_action] == pytest.approx([slope, slope * 1.5 * std], rel=1e-5)
    # log p = -noise^2 / 2 - log s - log(1 - tanh(u)^2) + const, with u moving along
    of_density = torch.autograd.grad(densities.sum(), [mean, log_std])
    expected = [2.0 * math.tanh(u), -1.0 + 2.0 * math.tanh(u) * 1.5 * std]
    assert [g.item() for g in of_density] == pytest.approx(expected, rel=1e-5)  # float32


def test_mean_network_deploys_the_tanh_of_the_mean() -> None:
    made = TanhGaussian(keys("a", "b"), "actor", (3 * len(FEATURES), 7, 3))
    frames = Normaliser(torch.zeros(2, len(FEATURES)), torch.ones(2, len(FEATURES)))
    policy = Policy.of_networks(policy_card(), {"actor": made.mean_network()}, frames)
    histories = normal(2, 5, 3, len(FEATURES))
    actions = policy.act(histories)
    assert actions.shape == (2, 5, 3)
    for lane in range(2):
        out = network(made.stack, lane, floats(histories)[lane].reshape(5, -1))
        # float32 sums of 18 products
        np.testing.assert_allclose(floats(actions)[lane], np.tanh(out[:, :3]), atol=1e-5)
