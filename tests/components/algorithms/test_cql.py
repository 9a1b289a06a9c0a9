"""CQL: conservative terms, targets, temperature and multiplier against plain loops."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms import cql
from components.data.batches import Batch
from components.data.dataset import OfflineDataset
from tests.components.algorithms.plain import (
    critic,
    floats,
    gaussian_parameters,
    squashed_log_density,
    unsquashed_log_density,
)
from tests.components.algorithms.stacks import config, learner, scattered
from tests.components.synthetic import make_log, relabelled

STEPS, BATCH, TRIED = 40, 3, 4
# float32 sums of a dozen values of a few units
CLOSE = {"rel": 1e-4, "abs": 1e-4}


def on_the_bounds() -> OfflineDataset:
    """A log with actions on both bounds, and a terminal at the end of the second episode."""
    log = make_log()
    actions, terminated = log.actions.copy(), np.zeros(log.transitions, dtype=np.bool_)
    actions[::3, 0], actions[1::3, 1] = 1.0, -1.0
    terminated[2 * STEPS - 1] = True
    return relabelled(log, actions=actions, terminated=terminated)


def small(lanes: int = 2, **changes: object) -> cql.Learner:
    """Learners whose networks are all different, targets included."""
    changes = {"batch": BATCH, "tried_actions": TRIED} | changes
    made = learner("cql", [on_the_bounds()] * lanes, list(range(lanes)), **changes)
    return scattered(made, 0.2, "actor", "critics", "critics_target")


def prepared(made: cql.Learner) -> tuple[Batch, dict[str, Tensor]]:
    """Transitions, a time-out and a terminal among them, and the noise of one update."""
    drawn = {k: v.clone() for k, v in made._streams.at(0).items()}
    drawn["row"] = torch.tensor([[3, STEPS - 1, 2 * STEPS - 1]] * made.lanes)
    return made._data.batch(drawn["row"]), drawn


def gaussian(made: cql.Learner, lane: int, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean before the tanh and deviation: the log deviation is clamped to [-5, 2]."""
    mean, log_std = gaussian_parameters(made._actor.stack, lane, seen)
    return mean, np.exp(np.clip(log_std, -5.0, 2.0))


def expected_targets(made: cql.Learner, batch: Batch, noise: Tensor, lane: int) -> list[float]:
    """r + gamma (1 - terminal) of the least target value of one sampled action; no entropy."""
    targets = []
    for i in range(BATCH):
        following = floats(batch.next_observations)[lane, i]
        mean, std = gaussian(made, lane, following)
        action = np.tanh(mean + std * floats(noise)[lane, i, 0])
        stack = made._critics_target.stack
        least = min(critic(stack, 2 * lane + j, following, action) for j in range(2))
        alive = floats(batch.continues)[lane, i]
        targets.append(floats(batch.rewards)[lane, i] + made._config.discount * alive * least)
    return targets


def expected_losses(
    made: cql.Learner, batch: Batch, drawn: dict[str, Tensor], lane: int, j: int
) -> tuple[float, float]:
    """Mean squared error and conservative term of critic j, action by action."""
    stack, width = made._critics.stack, 3
    targets = expected_targets(made, batch, drawn["target"], lane)
    error = gap = 0.0
    for i in range(BATCH):
        seen, following = (
            floats(o)[lane, i] for o in (batch.observations, batch.next_observations)
        )
        logged = critic(stack, 2 * lane + j, seen, floats(batch.actions)[lane, i])
        tried = []
        for action in floats(drawn["uniform"])[lane, i]:
            tried.append((action, width * math.log(0.5)))
        for state, name in ((seen, "here"), (following, "next")):
            mean, std = gaussian(made, lane, state)
            for noise in floats(drawn[name])[lane, i]:
                raw = mean + std * noise
                tried.append((np.tanh(raw), unsquashed_log_density(mean, std, raw)))
        values = [critic(stack, 2 * lane + j, seen, action) for action, _ in tried]  # all at s
        if made._config.variant == "h":
            values = [v - density for v, (_, density) in zip(values, tried, strict=True)]
        else:
            values.append(logged)
        error += (logged - targets[i]) ** 2 / BATCH
        gap += (np.log(np.sum(np.exp(values))) - logged) / BATCH
    return error, made._config.weight * gap


@pytest.mark.parametrize("weight", [5.0, 0.5])
@pytest.mark.parametrize("variant", ["h", "rho"])
def test_critic_losses_by_hand(variant: str, weight: float) -> None:
    made = small(variant=variant, weight=weight)
    batch, drawn = prepared(made)
    errors, gaps = made._critic_losses(made._critics, batch, *made._tried(batch, drawn))
    for lane in range(2):
        for j in range(2):
            error, gap = expected_losses(made, batch, drawn, lane, j)
            assert errors[lane, j].item() == pytest.approx(error, **CLOSE)  # no factor 1/2
            assert gaps[lane, j].item() == pytest.approx(gap, **CLOSE)


def test_targets_know_no_entropy_and_stop_at_terminals_alone() -> None:
    made = small()
    made._log_temperature.value.data.fill_(3.0)  # an entropy term would weigh e^3
    batch, drawn = prepared(made)
    assert batch.continues.tolist() == [[1.0, 1.0, 0.0]] * 2  # a time-out is bootstrapped
    targets, _, _ = made._tried(batch, drawn)
    for lane in range(2):
        expected = expected_targets(made, batch, drawn["target"], lane)
        assert targets[lane].tolist() == pytest.approx(expected, **CLOSE)
        assert targets[lane, 2] == batch.rewards[lane, 2]


def test_update_sums_errors_and_conservative_terms_of_both_critics() -> None:
    made = small(actor_learning_rate=1e-9)  # the actor's step comes first and must not matter
    before = small()
    metrics = made.update(0)
    drawn = made._streams.at(0)
    batch = made._data.batch(drawn["row"])
    for lane in range(2):
        twins = [expected_losses(before, batch, drawn, lane, j) for j in range(2)]
        error, gap = (sum(parts) for parts in zip(*twins, strict=True))
        assert metrics["critic/squared_error"][lane].item() == pytest.approx(error, **CLOSE)
        assert metrics["critic/conservative_gap"][lane].item() == pytest.approx(gap / 2, **CLOSE)
        assert metrics["critic/loss"][lane].item() == pytest.approx(error + gap, **CLOSE)


@pytest.mark.parametrize(("allowed", "direction"), [(0.0, 1.0), (1000.0, -1.0)])
def test_multiplier_grows_while_the_gap_is_too_large(allowed: float, direction: float) -> None:
    made = small(lagrange=allowed, actor_learning_rate=1e-9)
    made._log_multiplier.value.data = torch.tensor([0.0, 0.5])
    before = small()
    metrics = made.update(0)
    drawn = made._streams.at(0)
    batch = made._data.batch(drawn["row"])
    for lane, log_multiplier in enumerate((0.0, 0.5)):
        twins = [expected_losses(before, batch, drawn, lane, j) for j in range(2)]
        assert min(gap for _, gap in twins) > 0.0
        assert max(gap for _, gap in twins) < 1000.0
        expected = sum(error + math.exp(log_multiplier) * (gap - allowed) for error, gap in twins)
        assert metrics["critic/loss"][lane].item() == pytest.approx(expected, **CLOSE)
        # Adam's first step is the learning rate in the direction of the ascent
        moved = made._log_multiplier.value[lane].item() - log_multiplier
        assert moved == pytest.approx(direction * made._config.learning_rate, rel=1e-3)


def test_multiplier_is_clamped_to_a_million() -> None:
    made = small(lagrange=1.0)
    made._log_multiplier.value.data.fill_(20.0)  # e^20 is 485 million
    errors, gaps = torch.ones(2, 2), torch.tensor([[2.0, 4.0], [3.0, 1.0]])
    loss = made._weigh(errors, gaps, slice(0, 2))
    # float32 at 4e6 resolves 0.25
    assert loss.tolist() == pytest.approx([2.0 + 1e6 * (1.0 + 3.0), 2.0 + 1e6 * 2.0], abs=0.5)


def test_without_lagrange_no_multiplier_is_learned() -> None:
    for made, learned in ((small(), False), (small(lagrange=1.0), True)):
        made.update(0)
        assert any("log_multiplier" in name for name in made.state_dict()) == learned


def test_temperature_falls_on_wide_and_grows_on_narrow_policies() -> None:
    made = small()
    with torch.no_grad():
        last = made._actor.stack.layers[-1]
        last.weight.zero_()
        last.bias.zero_()
        # std 1 and e^-5: entropies of about 1.3 and -11, on both sides of the target -3
        last.bias[1, :, 3:] = -5.0
    metrics = made.update(0)
    # Adam's first step is the learning rate
    rate = made._config.actor_learning_rate
    assert made._log_temperature.value.tolist() == pytest.approx([-rate, rate], rel=1e-3)
    expected = [math.exp(-rate), math.exp(rate)]
    assert metrics["actor/temperature"].tolist() == pytest.approx(expected, rel=1e-6)  # float32


def test_actor_clones_at_first_and_climbs_the_values_later() -> None:
    made = small()  # 200 updates, of which 0.04 clone
    made._log_temperature.value.data = torch.tensor([0.0, -1.0])
    batch, drawn = prepared(made)
    rate = made._config.actor_learning_rate
    assert (batch.actions.abs() == 1.0).any()  # the inverse tanh of these would be infinite
    for step, clones in ((0, True), (7, True), (8, False), (199, False)):
        before = made._log_temperature.value.tolist()
        loss, metrics = made._actor_loss(batch, drawn["actor"], step)
        assert ("critic/value_magnitude" not in metrics) == clones
        for lane in range(2):
            # The temperature moves first: Adam's steps down an unchanging gradient are the rate.
            moved = made._log_temperature.value[lane].item()
            assert abs(moved - before[lane]) == pytest.approx(rate, rel=1e-2)
            temperature = math.exp(moved)
            own, pulled = [], []
            for i in range(BATCH):
                seen = floats(batch.observations)[lane, i]
                mean, std = gaussian(made, lane, seen)
                raw = mean + std * floats(drawn["actor"])[lane, i, 0]
                own.append(unsquashed_log_density(mean, std, raw))
                if clones:
                    action = floats(batch.actions)[lane, i]
                    pulled.append(squashed_log_density(mean, std, action, 1e-3))
                else:
                    stack = made._critics.stack
                    pulled.append(
                        min(critic(stack, 2 * lane + j, seen, np.tanh(raw)) for j in range(2))
                    )
            expected = temperature * np.mean(own) - np.mean(pulled)
            assert loss[lane].item() == pytest.approx(expected, **CLOSE)


def test_the_warm_up_is_the_authors_share_of_the_budget() -> None:
    made = small(updates=50)
    cloned = ["critic/value_magnitude" not in made.update(step) for step in range(6)]
    assert cloned == [True, True, False, False, False, False]
    settings = cql.Config()
    # 40,000 of a million
    assert settings.cloning * settings.updates == pytest.approx(300_000 * 40_000 / 1_000_000)


@pytest.mark.slow(1)
def test_a_warm_up_on_the_bounds_stays_finite() -> None:
    log = make_log()
    log = relabelled(log, actions=np.sign(log.actions).astype(np.float32))
    made = learner("cql", [log], [0], cloning=1.0, actor_learning_rate=0.03)
    for step in range(200):
        metrics = made.update(step)
        assert metrics["actor/loss"].isfinite().all()
        assert metrics["critic/loss"].isfinite().all()
    for name, tensor in made.state_dict().items():
        assert tensor.isfinite().all(), name


def test_uniform_actions_span_the_box() -> None:
    made = learner("cql", [make_log()], [0], batch=256, tried_actions=10)
    uniform = made._streams.at(0)["uniform"]
    assert uniform.shape == (1, 256, 10, 3)
    assert uniform.dtype == torch.float32
    assert uniform.abs().max() <= 1.0
    # 7,680 numbers: the chance that none is within 0.01 of an end is e^-38
    assert uniform.min() < -0.99
    assert uniform.max() > 0.99
    assert uniform.mean().abs() < 0.05  # 7 standard errors


def test_targets_follow_the_critics_after_their_step() -> None:
    made = small(target_rate=0.5, learning_rate=0.1)
    slow = [p.clone() for p in made._critics_target.parameters()]
    fast = [p.detach().clone() for p in made._critics.parameters()]
    made.update(0)
    for old, before, after, new in zip(
        slow, fast, made._critics.parameters(), made._critics_target.parameters(), strict=True
    ):
        assert (after - before).abs().max() > 0.05  # so that the order shows
        # two roundings in float32
        torch.testing.assert_close(new, 0.5 * old + 0.5 * after, rtol=1e-6, atol=1e-6)


def test_settings_outside_their_range_are_named() -> None:
    with pytest.raises(ValueError, match="variant be h or rho"):
        config("cql", variant="sac")
    with pytest.raises(ValueError, match="weight and lagrange must not be negative"):
        dataclasses.replace(config("cql"), weight=-1.0)
    with pytest.raises(ValueError, match="weight and lagrange must not be negative"):
        dataclasses.replace(config("cql"), lagrange=-1.0)
