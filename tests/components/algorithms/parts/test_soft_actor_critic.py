"""Soft actor-critic: targets, losses, gradients and the temperature against plain loops."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts.soft_actor_critic import SoftActorCritic
from components.data.batches import Batch, LaneData
from components.data.dataset import OfflineDataset
from tests.components.algorithms.plain import (
    critic,
    floats,
    gaussian_parameters,
    network,
    slopes,
    unsquashed_log_density,
)
from tests.components.algorithms.stacks import scattered, with_a_terminal
from tests.components.synthetic import CPU, keys, make_log, policy_card, relabelled

STEPS, BATCH, DISCOUNT = 40, 3, 0.97
# float32 sums of a dozen values of a few units
CLOSE = {"rel": 1e-4, "abs": 1e-4}


def alone(log: OfflineDataset, lanes: int = 2, **changes: Any) -> SoftActorCritic:
    settings = {
        "hidden": (8,),
        "learning_rate": 1e-3,
        "discount": DISCOUNT,
        "target_rate": 0.005,
    }
    data = LaneData([log] * lanes, CPU, 1e-3)
    return SoftActorCritic(data, keys(*range(lanes)), **(settings | changes))


def small(**changes: Any) -> SoftActorCritic:
    """Learners whose networks are all different, targets and temperatures included."""
    made = scattered(alone(with_a_terminal(), **changes), 0.2)
    made._log_temperature.value.data = torch.tensor([0.3, -0.7])
    return made


def prepared(made: SoftActorCritic) -> tuple[Batch, Tensor, Tensor]:
    """Transitions, a time-out and a terminal among them, and the noise of an update."""
    rows = torch.tensor([[3, STEPS - 1, 2 * STEPS - 1]] * made.lanes)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(2, made.lanes, BATCH, 1, 3, generator=generator)
    return made._data.batch(rows), noise[0], noise[1]


def drawn_action(made: Any, lane: int, seen: np.ndarray, noise: np.ndarray) -> tuple:
    """An action and its log density; the log deviation is clamped to [-20, 2]."""
    mean, log_std = gaussian_parameters(made._actor.stack, lane, seen)
    std = np.exp(np.clip(log_std, -20.0, 2.0))
    raw = mean + std * noise
    return np.tanh(raw), unsquashed_log_density(mean, std, raw)


def temperature(made: Any, lane: int) -> float:
    return math.exp(made._log_temperature.value[lane].item())


def expected_targets(made: Any, batch: Batch, noise: Tensor, lane: int) -> list[float]:
    """r + gamma (1 - terminal) (least target value of a sampled action - alpha log pi)."""
    targets = []
    for i in range(batch.rewards.shape[1]):
        following = floats(batch.next_observations)[lane, i]
        action, density = drawn_action(made, lane, following, floats(noise)[lane, i, 0])
        stack = made._critics_target.stack
        least = min(critic(stack, 2 * lane + j, following, action) for j in range(2))
        soft = least - temperature(made, lane) * density
        alive = floats(batch.continues)[lane, i]
        targets.append(floats(batch.rewards)[lane, i] + DISCOUNT * alive * soft)
    return targets


def expected_errors(made: Any, batch: Batch, targets: list[float], lane: int) -> list[np.ndarray]:
    """Distances of both critics to the targets."""
    pairs = np.concatenate([floats(batch.observations), floats(batch.actions)], axis=-1)[lane]
    return [network(made._critics.stack, 2 * lane + j, pairs)[:, 0] - targets for j in range(2)]


def expected_actor(made: Any, batch: Batch, noise: Tensor, lane: int) -> tuple[float, float]:
    """Actor's loss and mean log density of its actions."""
    losses, densities = [], []
    for i in range(batch.rewards.shape[1]):
        seen = floats(batch.observations)[lane, i]
        action, density = drawn_action(made, lane, seen, floats(noise)[lane, i, 0])
        stack = made._critics.stack
        least = min(critic(stack, 2 * lane + j, seen, action) for j in range(2))
        losses.append(temperature(made, lane) * density - least)
        densities.append(density)
    return float(np.mean(losses)), float(np.mean(densities))


def compare_an_update(
    made: Any, now: Any, batch: Batch, noise: tuple[Tensor, Tensor], metrics: dict[str, Tensor]
) -> None:
    """Losses and gradients of ``made``'s step, from ``now``, the same learner before it."""
    following, own = noise
    for lane in range(2):
        targets = expected_targets(now, batch, following, lane)
        assert metrics["critic/target_mean"][lane].item() == pytest.approx(
            np.mean(targets), **CLOSE
        )
        errors = expected_errors(now, batch, targets, lane)
        loss = sum(0.5 * np.mean(error**2) for error in errors)
        assert metrics["critic/loss"][lane].item() == pytest.approx(loss, **CLOSE)
        bias = made._critics.stack.affine()[-1][1]
        for j, error in enumerate(errors):
            gradient = bias.grad[2 * lane + j].item()
            assert gradient == pytest.approx(np.mean(error), **CLOSE)
    stale = [expected_actor(now, batch, own, lane)[0] for lane in range(2)]
    now._critics.load_state_dict(made._critics.state_dict())  # the critics, then the actor
    now._actor.double()
    for lane in range(2):
        loss, density = expected_actor(now, batch, own, lane)
        assert abs(loss - stale[lane]) > 1e-3, "the order of the steps must show"
        assert metrics["actor/loss"][lane].item() == pytest.approx(loss, **CLOSE)
        assert metrics["actor/entropy"][lane].item() == pytest.approx(-density, **CLOSE)
        last = now._actor.stack.affine()[-1][1].data[lane, 0]
        climbed = slopes(lambda n=lane: expected_actor(now, batch, own, n)[0], last)
        assert max(abs(slope) for slope in climbed) > 1e-3
        gradient = made._actor.stack.affine()[-1][1].grad[lane, 0]
        assert gradient.tolist() == pytest.approx(climbed, rel=1e-3, abs=1e-5)  # float32
        # The temperature rises while the mean log density is above that of entropy -3.
        step = made._log_temperature.value.grad[lane].item()
        assert step == pytest.approx(-(density - 3.0), **CLOSE)


def test_an_update_by_hand() -> None:
    changes = {"learning_rate": 0.05}  # bold, so that the order of the steps shows
    made, now = small(**changes), small(**changes)
    batch, following, own = prepared(made)
    metrics = made.improve(batch, following, own)
    compare_an_update(made, now, batch, (following, own), metrics)


def test_targets_stop_at_terminals_alone() -> None:
    made = small()
    batch, following, _ = prepared(made)
    assert batch.continues.tolist() == [[1.0, 1.0, 0.0]] * 2  # a time-out is bootstrapped
    targets = made._targets(batch, following)
    assert torch.equal(targets[:, 2], batch.rewards[:, 2])
    assert bool((targets[:, :2] != batch.rewards[:, :2]).all())


def test_targets_follow_the_critics_after_their_step() -> None:
    made = small(target_rate=0.5, learning_rate=0.1)
    slow = [p.clone() for p in made._critics_target.parameters()]
    fast = [p.detach().clone() for p in made._critics.parameters()]
    made.improve(*prepared(made))
    for old, before, after, new in zip(
        slow, fast, made._critics.parameters(), made._critics_target.parameters(), strict=True
    ):
        assert (after - before).abs().max() > 0.05  # so that the order shows
        # two roundings in float32
        torch.testing.assert_close(new, 0.5 * old + 0.5 * after, rtol=1e-6, atol=1e-6)


def test_temperature_falls_on_wide_and_grows_on_narrow_policies() -> None:
    made = alone(make_log())
    with torch.no_grad():
        last = made._actor.stack.layers[-1]
        last.weight.zero_()
        last.bias.zero_()
        # std 1 and e^-5: entropies of about 1.3 and -11, on both sides of the target -3
        last.bias[1, :, 3:] = -5.0
    metrics = made.improve(*prepared(made))
    # Adam's first step is the learning rate; float32
    expected = [math.exp(-1e-3), math.exp(1e-3)]
    assert metrics["actor/temperature"].tolist() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("terminal", "value"), [(False, 1.0 / (1.0 - 0.6)), (True, 1.0)])
@pytest.mark.slow(2)
def test_value_of_a_constant_reward(terminal: bool, value: float) -> None:
    """Without a price of entropy: Q = r / (1 - gamma) where nothing ends, r where all does."""
    log = make_log()
    ones = np.ones(log.transitions, dtype=np.float32)
    log = relabelled(log, rewards=ones, terminated=np.full(log.transitions, terminal))
    made = alone(log, 1, learning_rate=3e-3, discount=0.6, target_rate=0.1)
    made._log_temperature.value.data.fill_(-20.0)
    generator = torch.Generator().manual_seed(2)
    for _ in range(600):
        rows = torch.randint(log.transitions, (1, 64), generator=generator)
        noise = torch.randn(2, 1, 64, 1, 3, generator=generator)
        made.improve(made._data.batch(rows), noise[0], noise[1])
    batch = made._data.batch(torch.arange(0, log.transitions, 3)[None])
    values = made._critics(batch.observations, batch.actions)
    # as of the other critics in the probe worlds
    assert values.mean().item() == pytest.approx(value, rel=0.06)
    assert (values - value).square().mean().sqrt().item() < 0.1 * value


def test_deployed_is_the_tanh_of_the_mean() -> None:
    made = small()
    log = with_a_terminal()
    policy = made.policy(policy_card(log))
    assert policy.card.kind == "tanh"
    index = torch.tensor([[0, 7, 90]] * 2)
    observations = made._data.observations(index)
    actions = policy.act(made._data.raw_histories(index))
    for lane in range(2):
        for i in range(3):
            seen = floats(observations)[lane, i]
            mean, _ = gaussian_parameters(made._actor.stack, lane, seen)
            # scaled twice in float32
            np.testing.assert_allclose(actions[lane, i], np.tanh(mean), atol=1e-5)
