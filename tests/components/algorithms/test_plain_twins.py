"""What saves operations follows its plain twin: the same updates from PyTorch's own gradients."""

import pytest
import torch
from torch import Tensor

from components.networks import Critics, TanhGaussian, stacked
from components.networks.gaussian import Sample, log_density
from tests.components.algorithms.stacks import learner, run
from tests.components.synthetic import make_log

UPDATES = 100
LEARNERS = ("ddpg", "td3_bc", "bcq", "bear", "brac", "cql", "mopo")


def first_layer(weight: Tensor, bias: Tensor, observations: Tensor, actions: Tensor) -> Tensor:
    """Every pair joined, then one product."""
    several = observations[:, :, None].expand(-1, -1, actions.shape[2], -1)
    pairs = torch.cat([several, actions], dim=-1).flatten(1, 2)
    return torch.baddbmm(bias, pairs, weight)


def first(critics: Critics, observations: Tensor, actions: Tensor) -> Tensor:
    return critics(observations, actions)[:, 0]


def least(critics: Critics, observations: Tensor, actions: Tensor) -> Tensor:
    values: Tensor = critics(observations, actions)
    return values.amin(dim=1)


def errors(critics: Critics, observations: Tensor, actions: Tensor, targets: Tensor) -> Tensor:
    values: Tensor = critics(observations, actions)
    return (values - targets[:, None]).square().mean(dim=2)


def draw(parameters: tuple[Tensor, Tensor], noise: Tensor) -> Sample:
    """The density found back from the sample instead of taken from its noise."""
    mean, log_std = (p[:, :, None] for p in parameters)
    raw = mean + log_std.exp() * noise
    return torch.tanh(raw), raw, log_density(mean, log_std, raw)


@pytest.mark.slow(2)
@pytest.mark.parametrize("name", LEARNERS)
def test_updates_are_those_of_the_plain_twin(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    log = make_log()
    fresh, fast = (learner(name, [log] * 2, range(2)) for _ in range(2))
    run(fast, UPDATES)
    monkeypatch.setattr(stacked._FirstLayer, "apply", first_layer)
    for plain in (first, least, errors):
        monkeypatch.setattr(Critics, plain.__name__, plain)
    monkeypatch.setattr(TanhGaussian, "draw", staticmethod(draw))
    twin = learner(name, [log] * 2, range(2))
    run(twin, UPDATES)
    moved = 0.0
    for key, expected in twin.state_dict().items():
        if "optimizer" in key or key.startswith("buffer."):
            continue
        # Sums in another order differ in the last digit; Adam turns that difference in a tiny
        # gradient into one of its step's size, 1e-3, and 100 updates leave this much.
        torch.testing.assert_close(fast.state_dict()[key], expected, rtol=1e-2, atol=1e-3)
        moved = max(moved, float((expected - fresh.state_dict()[key]).abs().max()))
    assert moved > 0.03  # the tolerance means something only where training moved the weights
