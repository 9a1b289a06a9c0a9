"""BRAC-v: its losses, targets and phases against plain loops."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms import brac
from components.data.batches import Batch
from components.data.dataset import OfflineDataset
from tests.components.algorithms.plain import (
    critic,
    floats,
    gaussian_parameters,
    network,
    squashed_log_density,
    unsquashed_log_density,
)
from tests.components.algorithms.stacks import config, learner, run, scattered
from tests.components.synthetic import make_log, relabelled

STEPS = 40
MARGIN = 1e-3  # the authors' clip inside densities
# Densities lose digits near the bounds: d atanh / da is 500 at 0.999, and float32 has 6e-8.
CLOSE = {"rel": 2e-4, "abs": 2e-4}


def on_the_bounds() -> OfflineDataset:
    """A log with actions on both bounds, and terminals."""
    log = make_log()
    actions, terminated = log.actions.copy(), np.zeros(log.transitions, dtype=np.bool_)
    actions[::3, 0], actions[1::3, 1] = 1.0, -1.0
    terminated[2 * STEPS - 1] = True  # the second episode ends in a terminal, the others in time
    return relabelled(log, actions=actions, terminated=terminated)


def small(lanes: int = 2, **changes: object) -> brac.Learner:
    """Learners whose networks are all different, targets included."""
    made = learner("brac", [on_the_bounds()] * lanes, list(range(lanes)), **changes)
    return scattered(made, 0.3, "actor", "behaviour", "critics_target")


def rows(made: brac.Learner, *numbers: int) -> Batch:
    return made._data.batch(torch.tensor([numbers] * made.lanes))


def normal(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


def gaussian(policy: object, lane: int, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean before the tanh and deviation: log std = -5 + 2.5 (tanh h + 1)."""
    mean, spread = gaussian_parameters(policy.stack, lane, observation)  # type: ignore[attr-defined]
    return mean, np.exp(-5.0 + 2.5 * (np.tanh(spread) + 1.0))


def divergence(
    made: brac.Learner, lane: int, observation: np.ndarray, noise: np.ndarray
) -> tuple[float, list[np.ndarray]]:
    """Mean of log pi - log b over the drawn actions of one state, and these actions."""
    mean, std = gaussian(made._actor, lane, observation)
    logged_mean, logged_std = gaussian(made._behaviour, lane, observation)
    total, actions = 0.0, []
    for drawn in noise:
        raw = mean + std * drawn
        actions.append(np.tanh(raw))
        total += unsquashed_log_density(mean, std, raw)
        total -= squashed_log_density(logged_mean, logged_std, actions[-1], MARGIN)
    return total / len(noise), actions


def test_behaviour_loss_by_hand() -> None:
    made = small()
    weights = [0.7, 0.2]
    made._entropy_weight.value.data = torch.tensor(weights)
    batch, noise = rows(made, 0, 1, 2, 50, 79), normal(2, 5, 1, 3)
    assert (batch.actions.abs() == 1.0).any()  # the inverse tanh of these would be infinite
    loss, own = made._behaviour_loss(batch, noise)
    for lane in range(2):
        logged, drawn = [], []
        for i in range(5):
            mean, std = gaussian(made._behaviour, lane, floats(batch.observations)[lane, i])
            action = floats(batch.actions)[lane, i]
            logged.append(squashed_log_density(mean, std, action, MARGIN))
            raw = mean + std * floats(noise)[lane, i, 0]
            drawn.append(unsquashed_log_density(mean, std, raw))
        assert own[lane].item() == pytest.approx(np.mean(drawn), **CLOSE)
        expected = weights[lane] * np.mean(drawn) - np.mean(logged)
        assert loss[lane].item() == pytest.approx(expected, **CLOSE)


def test_entropy_weight_falls_on_wide_and_grows_on_narrow_behaviour() -> None:
    made = learner("brac", [make_log()] * 3, [0, 1, 2])
    with torch.no_grad():
        last = made._behaviour.stack.layers[-1]
        last.weight.zero_()
        # std 1, e^-5 and 1: entropies of about 0 and -11 on both sides of the target -3
        last.bias[:, :, 3:] = torch.tensor([20.0, -20.0, 20.0])[:, None, None]
        made._entropy_weight.value[2] = 1e-4
    metrics = made.update(0)
    entropy = metrics["behaviour/entropy"]
    assert entropy[0] > -3.0 > entropy[1]
    assert entropy[2] > -3.0
    # Adam's first step is the learning rate in the gradient's direction; the last one meets 0
    rate = made._config.cloning_learning_rate
    expected = [1.0 - rate, 1.0 + rate, 0.0]
    # float32 at 1 has 6e-8
    assert made._entropy_weight.value.tolist() == pytest.approx(expected, abs=1e-6)
    assert metrics["behaviour/entropy_weight"].tolist() == made._entropy_weight.value.tolist()
    assert made._entropy_weight.value[2] == 0.0


def test_sampled_divergence_by_plain_loops() -> None:
    made = small()
    with torch.no_grad():  # wide actors, so that some actions lie beyond the clip
        made._actor.stack.layers[-1].bias[:, :, 3:] += 3.0
    batch, noise = rows(made, 0, 7, 50), 3.0 * normal(2, 3, 4, 3)
    drawn = made._actor.draw(made._actor(batch.observations), noise)
    beyond = drawn[0].abs() > 1.0 - MARGIN
    assert beyond.any()
    assert not beyond.all()
    found = made._divergence(batch.observations, drawn)
    for lane in range(2):
        for i in range(3):
            expected, _ = divergence(
                made, lane, floats(batch.observations)[lane, i], floats(noise)[lane, i]
            )
            assert found[lane, i].item() == pytest.approx(expected, **CLOSE)


def expected_targets(made: brac.Learner, batch: Batch, noise: Tensor, lane: int) -> list[float]:
    """r + gamma (1 - terminal) [least target value of the first action - alpha D]."""
    settings, targets = made._config, []
    for i in range(batch.rewards.shape[1]):
        following = floats(batch.next_observations)[lane, i]
        apart, actions = divergence(made, lane, following, floats(noise)[lane, i])
        stack = made._critics_target.stack
        least = min(critic(stack, 2 * lane + j, following, actions[0]) for j in range(2))
        ahead = least - settings.alpha * apart
        alive = floats(batch.continues)[lane, i]
        targets.append(floats(batch.rewards)[lane, i] + settings.discount * alive * ahead)
    return targets


def test_targets_pay_for_divergence_and_stop_at_terminals_alone() -> None:
    made = small(alpha=0.5)
    batch, noise = rows(made, 3, STEPS - 1, 2 * STEPS - 1), normal(2, 3, 4, 3)
    assert batch.continues.tolist() == [[1.0, 1.0, 0.0]] * 2  # a time-out is bootstrapped
    targets = made._targets(batch, noise)
    for lane in range(2):
        expected = expected_targets(made, batch, noise, lane)
        assert targets[lane].tolist() == pytest.approx(expected, **CLOSE)
        assert targets[lane, 2] == batch.rewards[lane, 2]


def test_the_behaviour_is_learned_first() -> None:
    made = small()
    branches = [made.branch(step) for step in range(made.pretraining + 1)]
    assert branches == ["behaviour"] * made.pretraining + ["values"]


def test_actor_loss_leaves_values_out_until_the_warm_up_ends() -> None:
    made = small(alpha=0.3)
    batch, noise = rows(made, 3, 50, 100), normal(2, 3, 4, 3)
    first = 0.04 * 100  # of 100 updates
    for step, sees_values in ((0, False), (first - 1, False), (first, True), (99, True)):
        follows = made.branch(made.pretraining + int(step)) == "actor"
        loss, metrics = made._actor_loss(batch, noise, follows)
        assert ("critic/value_magnitude" in metrics) == sees_values
        for lane in range(2):
            expected = 0.0
            for i in range(3):
                seen = floats(batch.observations)[lane, i]
                apart, actions = divergence(made, lane, seen, floats(noise)[lane, i])
                expected += 0.3 * apart / 3
                if sees_values:
                    values = [
                        critic(made._critics.stack, 2 * lane + j, seen, actions[0])
                        for j in range(2)
                    ]
                    expected -= min(values) / 3
            assert loss[lane].item() == pytest.approx(expected, **CLOSE)


def test_targets_move_before_the_critics_do() -> None:
    made = small(target_rate=0.5, learning_rate=0.1)
    step = made.pretraining
    drawn = {k: v.clone() for k, v in made._streams.at(step).items()}
    batch = made._data.batch(drawn["row"])
    online = [p.detach().clone() for p in made._critics.parameters()]
    expected = [
        0.5 * old + 0.5 * new
        for old, new in zip(made._critics_target.parameters(), online, strict=True)
    ]
    metrics = made.update(step)
    for ours, theirs in zip(made._critics_target.parameters(), expected, strict=True):
        # two roundings in float32; the critics' own step was 0.1
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)
    for before, after in zip(online, made._critics.parameters(), strict=True):
        assert (after - before).abs().max() > 0.05
    # the batch's targets are those of the moved targets and of the actor before its step
    before_step = small()
    before_step._critics_target.load_state_dict(made._critics_target.state_dict())
    for lane in range(2):
        means = np.mean(expected_targets(before_step, batch, drawn["next"], lane))
        assert metrics["critic/target_mean"][lane].item() == pytest.approx(means, **CLOSE)


def test_critic_loss_is_the_sum_of_two_mean_squared_errors() -> None:
    made = small(target_rate=1.0)  # the targets become the critics, whose values are known
    step = made.pretraining
    drawn = {k: v.clone() for k, v in made._streams.at(step).items()}
    batch = made._data.batch(drawn["row"])
    before = small()
    before._critics_target.load_state_dict(made._critics.state_dict())
    metrics = made.update(step)
    for lane in range(2):
        targets = np.array(expected_targets(before, batch, drawn["next"], lane))
        pairs = np.concatenate(
            [floats(batch.observations)[lane], floats(batch.actions)[lane]], axis=1
        )
        expected = sum(
            np.mean((network(before._critics.stack, 2 * lane + j, pairs)[:, 0] - targets) ** 2)
            for j in range(2)
        )
        assert metrics["critic/loss"][lane].item() == pytest.approx(expected, rel=1e-3)  # squares


def test_behaviour_learns_first_and_is_frozen_afterwards() -> None:
    made = learner("brac", [make_log()], [0])
    assert made.pretraining == 10
    for step in range(14):
        before = {k: v.clone() for k, v in made.state_dict().items()}
        made.update(step)
        after = made.state_dict()
        moved = {
            name.split(".")[0]
            for name in after
            if name not in before or not torch.equal(after[name], before[name])
        }
        pretrained = {"behaviour", "entropy_weight"}
        optimised = pretrained if step < 10 else {"actor", "critics"}
        expected = optimised | {f"{name}_optimizer" for name in optimised}
        # the targets start as copies, so their first move goes nowhere
        assert moved == expected | ({"critics_target"} if step > 10 else set())


@pytest.mark.parametrize(("updates", "pretraining"), [(10_000, 6_000), (500, 300), (1, 1)])
def test_pretraining_is_three_fifths_of_the_updates(updates: int, pretraining: int) -> None:
    assert brac.Config(updates=updates).pretraining == pretraining


@pytest.mark.slow(2)
def test_pretraining_comes_near_the_logged_density() -> None:
    """One operator with Gaussian deeds: tanh(N(-0.5, 0.3^2)) in every state."""
    log = make_log(episodes=20)
    raw = np.random.default_rng(0).normal(-0.5, 0.3, log.actions.shape)
    log = relabelled(log, actions=np.tanh(raw).astype(np.float32))
    changes = {"updates": 2000, "cloning": 0.4, "cloning_learning_rate": 3e-3, "batch": 64}
    made = learner("brac", [log], [0], **changes)
    metrics = run(made, 800)
    mean, log_std = made._behaviour(made._data.observations(torch.arange(0, 800, 7)[None]))
    # measured -0.515 and log 0.31; at first the means are around 0, the deviations e^-2.5
    assert mean.mean().item() == pytest.approx(-0.5, abs=0.1)
    assert log_std.mean().item() == pytest.approx(math.log(0.3), abs=0.15)
    # the log's entropy is about -0.3, far above the target -3: nothing holds the clone wide
    assert metrics[-1]["behaviour/entropy_weight"] == 0.0


def test_settings_outside_their_range_are_named() -> None:
    for changes in ({"alpha": -0.1}, {"cloning": -1.0}, {"warm_up": 1.5}):
        with pytest.raises(ValueError, match="must not be negative; warm_up lies in"):
            config("brac", **changes)
