"""BEAR: the discrepancy, its multiplier, targets and losses against plain loops."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms import bear
from components.algorithms.parts.learner import descend
from components.data.batches import Batch
from tests.components.algorithms.plain import (
    critic,
    discrepancy_by_loops,
    floats,
    gaussian_parameters,
    network,
    slopes,
)
from tests.components.algorithms.stacks import (
    config,
    drawn_by,
    learner,
    run,
    scattered,
    with_a_terminal,
)
from tests.components.synthetic import make_log, policy_card, relabelled

STEPS, BATCH = 40, 4
# float32 through three networks
CLOSE = {"rel": 1e-4, "abs": 1e-5}
# large steps and a narrow limit, so that order and clamp show
BOLD = {"learning_rate": 0.05, "actor_learning_rate": 0.05, "raw_limit": 0.6, "warm_up": 0.0}


def small(lanes: int = 2, **changes: object) -> bear.Learner:
    """Learners whose networks are all different, targets included."""
    changes = {"batch": BATCH} | changes
    logs = [with_a_terminal()] * lanes
    return scattered(learner("bear", logs, list(range(lanes)), **changes), 0.3)


def raw_samples(made: bear.Learner, lane: int, seen: np.ndarray, noise: Tensor) -> np.ndarray:
    """Samples of the actor before the tanh."""
    mean, log_std = gaussian_parameters(made._actor.stack, lane, seen)
    std = np.exp(np.clip(log_std, -5.0, 2.0))
    return np.array([mean + std * floats(n) for n in noise])


def raw_generated(made: bear.Learner, lane: int, seen: np.ndarray, noise: Tensor) -> np.ndarray:
    """Samples of the autoencoder before the tanh."""
    inputs = [np.concatenate([seen, np.clip(floats(z), -0.5, 0.5)]) for z in noise]
    return network(made._vae.decoder, lane, np.array(inputs))


def expected_targets(made: bear.Learner, batch: Batch, noise: Tensor, lane: int) -> list[float]:
    """r + gamma (1 - terminal) times the best mixed target value among the actor's samples."""
    targets, stack = [], made._critics_target.stack
    for i in range(batch.rewards.shape[1]):
        following, mixed = floats(batch.next_observations)[lane, i], []
        for raw in raw_samples(made, lane, following, noise[lane, i]):
            twins = [critic(stack, 2 * lane + j, following, np.tanh(raw)) for j in range(2)]
            mixed.append(0.75 * min(twins) + 0.25 * max(twins))
        alive = floats(batch.continues)[lane, i]
        targets.append(batch.rewards[lane, i].item() + 0.97 * alive * max(mixed))
    return targets


def expected_discrepancy(
    made: bear.Learner, batch: Batch, drawn: dict[str, Tensor], lane: int
) -> float:
    """Mean over states; all samples of both sides, before the tanh."""
    settings, found = made._config, []
    for i in range(BATCH):
        seen = floats(batch.observations)[lane, i]
        logged = raw_generated(made, lane, seen, drawn["generated"][lane, i])
        logged = np.clip(logged, -settings.raw_limit, settings.raw_limit)
        own = raw_samples(made, lane, seen, drawn["actor"][lane, i])
        found.append(discrepancy_by_loops(logged, own, settings.kernel, settings.sigma))
    return float(np.mean(found))


def first_sample_values(
    made: bear.Learner, batch: Batch, drawn: dict[str, Tensor], lane: int
) -> list[list[float]]:
    """Both critics' values at the actor's first sample, state by state."""
    values, stack = [], made._critics.stack
    for i in range(BATCH):
        seen = floats(batch.observations)[lane, i]
        action = np.tanh(raw_samples(made, lane, seen, drawn["actor"][lane, i, :1])[0])
        values.append([critic(stack, 2 * lane + j, seen, action) for j in range(2)])
    return values


def expected_value(made: bear.Learner, batch: Batch, drawn: dict[str, Tensor], lane: int) -> float:
    """Mean of the least critic at the actor's first sample."""
    return float(np.mean([min(twins) for twins in first_sample_values(made, batch, drawn, lane)]))


def expected_actor_loss(
    made: bear.Learner, batch: Batch, drawn: dict[str, Tensor], lane: int
) -> float:
    """After the warm-up."""
    apart = expected_discrepancy(made, batch, drawn, lane)
    multiplier = math.exp(made._log_multiplier.value[lane].item())
    value = expected_value(made, batch, drawn, lane)
    return multiplier * (apart - made._config.threshold) - value


def first_gradient(made: bear.Learner, name: str, bias: Tensor) -> Tensor:
    """What Adam has seen in its only step: its first moment is a tenth of it."""
    return made._optimizers[name].state[bias]["exp_avg"] / 0.1


def state_of(made: bear.Learner) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in made.state_dict().items()}


def moved(made: bear.Learner, before: dict[str, Tensor]) -> set[str]:
    after = made.state_dict()
    return {
        name.split(".")[0]
        for name, old in before.items()
        if "optimizer" not in name and not torch.equal(after[name], old)
    }


# -- targets, losses, updates -------------------------------------------------------------------


def test_targets_by_hand_stop_at_terminals_alone() -> None:
    made = small(target_actions=5)
    _, drawn = drawn_by(made)
    rows = torch.tensor([[STEPS - 1, 2 * STEPS - 1, 3, 100]] * 2)
    batch = made._data.batch(rows)
    assert batch.continues.tolist() == [[1.0, 0.0, 1.0, 1.0]] * 2  # a time-out goes on
    assert drawn["target"].shape == (2, BATCH, 5, 3)
    targets = made._targets(batch, drawn["target"])
    for lane in range(2):
        expected = expected_targets(made, batch, drawn["target"], lane)
        assert targets[lane].tolist() == pytest.approx(expected, **CLOSE)
        assert targets[lane, 1] == batch.rewards[lane, 1]


@pytest.mark.parametrize("kernel", ["laplacian", "gaussian"])
def test_one_update_by_hand(kernel: str) -> None:
    settings = BOLD | {"kernel": kernel, "sigma": 1.5}
    made, now = small(**settings), small(**settings)
    batch, drawn = drawn_by(made)
    metrics = made.update(0)
    log_multipliers = now._log_multiplier.value.tolist()
    assert min(abs(v) for v in log_multipliers) > 0.01
    for lane in range(2):
        targets = expected_targets(now, batch, drawn["target"], lane)
        assert metrics["critic/target_mean"][lane].item() == pytest.approx(
            np.mean(targets), **CLOSE
        )
        loss = 0.0
        for j in range(2):
            pairs = np.concatenate([floats(batch.observations), floats(batch.actions)], axis=-1)
            errors = network(now._critics.stack, 2 * lane + j, pairs[lane])[:, 0] - targets
            loss += np.mean(errors**2)
            _, bias = made._critics.stack.affine()[-1]
            gradient = first_gradient(made, "critics", bias)[2 * lane + j].item()
            assert gradient == pytest.approx(2.0 * np.mean(errors), **CLOSE)
        assert metrics["critic/loss"][lane].item() == pytest.approx(loss, **CLOSE)
    stale = [expected_actor_loss(now, batch, drawn, lane) for lane in range(2)]
    now._vae.load_state_dict(made._vae.state_dict())  # autoencoder and critics step first
    half_stale = [expected_actor_loss(now, batch, drawn, lane) for lane in range(2)]
    now._critics.load_state_dict(made._critics.state_dict())
    now._actor.double()
    for lane in range(2):
        apart = expected_discrepancy(now, batch, drawn, lane)
        loss = expected_actor_loss(now, batch, drawn, lane)
        multiplier = math.exp(log_multipliers[lane])
        assert metrics["actor/discrepancy"][lane].item() == pytest.approx(apart, **CLOSE)
        assert metrics["actor/multiplier"][lane].item() == pytest.approx(multiplier, **CLOSE)
        assert metrics["actor/loss"][lane].item() == pytest.approx(loss, **CLOSE)
        assert abs(half_stale[lane] - stale[lane]) > 1e-3
        assert abs(loss - half_stale[lane]) > 1e-3
        own = now._actor.stack.affine()[-1][1].data[lane, 0]
        fell = slopes(lambda n=lane: expected_actor_loss(now, batch, drawn, n), own)
        assert min(abs(slope) for slope in fell) > 1e-4
        gradient = first_gradient(made, "actor", made._actor.stack.affine()[-1][1])[lane, 0]
        assert gradient.tolist() == pytest.approx(fell, rel=1e-3, abs=1e-5)  # float32


def test_logged_samples_are_clamped_before_the_kernel() -> None:
    made = small(raw_limit=0.6)
    batch, drawn = drawn_by(made)
    with torch.no_grad():
        made._vae.decoder.affine()[-1][1].add_(torch.tensor([50.0, -50.0, 0.0]))
    _, discrepancy, _ = made._actor_loss(batch, drawn, 0)
    for lane in range(2):
        expected = expected_discrepancy(made, batch, drawn, lane)
        assert discrepancy[lane].item() == pytest.approx(expected, **CLOSE)
        assert expected < 0.5  # without the clamp 100 / (2 sigma) = 2.5 away, nearly sqrt(2)


def test_values_enter_after_the_warm_up_with_the_first_sample_only() -> None:
    made = small(warm_up=0.1)  # of 200 updates
    batch, drawn = drawn_by(made)
    for lane in range(2):  # each critic shall be the least at some states
        twins = np.array(first_sample_values(made, batch, drawn, lane))
        last = made._critics.stack.affine()[-1][1].data
        last[2 * lane + 1] += float(np.mean(twins[:, 0] - twins[:, 1]))
        twins = np.array(first_sample_values(made, batch, drawn, lane))
        assert set(twins.argmin(axis=1)) == {0, 1}
    other = drawn | {"actor": drawn["actor"].clone()}
    other["actor"][:, :, 1:] *= -1.0
    for step, warm in ((0, True), (19, True), (20, False), (199, False)):
        loss, apart, metrics = made._actor_loss(batch, drawn, step)
        assert ("critic/value_magnitude" not in metrics) == warm
        again, changed, _ = made._actor_loss(batch, other, step)
        assert not torch.equal(apart, changed)  # all samples are compared with the log
        for lane in range(2):
            multiplier = math.exp(made._log_multiplier.value[lane].item())
            matched = multiplier * (expected_discrepancy(made, batch, drawn, lane) - 0.05)
            value = 0.0 if warm else expected_value(made, batch, drawn, lane)
            assert loss[lane].item() == pytest.approx(matched - value, **CLOSE)
            rest = again[lane].item() - multiplier * (changed[lane].item() - 0.05)
            assert rest == pytest.approx(-value, **CLOSE)
            assert warm or abs(value) > 0.01


@pytest.mark.parametrize(("updates", "share", "length"), [(50, 0.06, 3), (8, 0.5, 4), (9, 0.0, 0)])
def test_warm_up_is_a_share_of_the_budget(updates: int, share: float, length: int) -> None:
    made = small(updates=updates, warm_up=share)
    warm = ["critic/value_magnitude" not in made.update(step) for step in range(6)]
    assert warm == [step < length for step in range(6)]


def test_default_warm_up_is_the_authors_share() -> None:
    settings = bear.Config()
    # 40,000 of a million
    assert settings.warm_up * settings.updates == pytest.approx(10_000 * 40_000 / 1_000_000)


@pytest.mark.parametrize(("threshold", "direction"), [(1e-4, 1.0), (100.0, -1.0)])
def test_multiplier_grows_while_the_discrepancy_is_too_large(
    threshold: float, direction: float
) -> None:
    made = small(lanes=3, threshold=threshold)
    end = 10.0 if direction > 0 else -5.0
    starts = [0.0, 1.5, end - 2e-4 * direction]
    made._log_multiplier.value.data = torch.tensor(starts)
    rate = made._config.multiplier_learning_rate
    assert rate == 1e-3
    metrics = made.update(0)
    # the square root alone is at least 1e-3; nothing comes near 100
    assert (direction * (metrics["actor/discrepancy"] - threshold)).min() > 0.0
    values = made._log_multiplier.value.tolist()
    # Adam's first step is the learning rate; the third lane reaches its clamp before
    expected = [0.0 + rate * direction, 1.5 + rate * direction, end]
    assert values == pytest.approx(expected, abs=1e-6)  # float32
    assert values[2] == end
    for step in range(1, 4):
        made.update(step)
    assert made._log_multiplier.value[2] == end


def test_every_network_moves_and_targets_by_tau() -> None:
    made = small(target_rate=0.2, warm_up=0.005)  # one update of 200
    for step in range(3):
        before = state_of(made)
        made.update(step)
        assert moved(made, before) == {
            "vae",
            "critics",
            "actor",
            "critics_target",
            "log_multiplier",
        }
        after = made.state_dict()
        slow = [name for name in before if name.startswith("critics_target.")]
        assert slow
        for name in slow:
            online = after[name.replace("_target", "")]
            # two roundings in float32
            torch.testing.assert_close(
                after[name], 0.8 * before[name] + 0.2 * online, rtol=1e-6, atol=1e-7
            )


def test_every_network_has_its_own_learning_rate() -> None:
    rates = {"vae": 0.01, "critics": 0.01, "actor": 0.02, "log_multiplier": 0.03}
    changes = {"learning_rate": 0.01, "actor_learning_rate": 0.02}
    made = learner("bear", [make_log()], [0], multiplier_learning_rate=0.03, **changes)
    assert made._log_multiplier.value.tolist() == [0.0]  # it starts at alpha = 1
    before = state_of(made)
    made.update(0)
    after = made.state_dict()
    for network_name, rate in rates.items():
        steps = [
            (after[name] - old).abs().max().item()
            for name, old in before.items()
            if name.split(".")[0] == network_name
        ]
        # Adam's first step is the learning rate, short of it where gradients are near 1e-8
        assert max(steps) == pytest.approx(rate, rel=1e-3)


def test_the_actors_loss_moves_the_actor_alone() -> None:
    made = small(warm_up=0.0)
    batch, drawn = drawn_by(made)
    before = state_of(made)
    loss, _, _ = made._actor_loss(batch, drawn, 0)
    descend(made._optimizers["actor"], loss)
    assert moved(made, before) == {"actor"}


def test_the_autoencoder_learns_as_if_it_were_alone() -> None:
    made, alone = small(warm_up=0.0), small()
    for step in range(3):
        batch, drawn = drawn_by(alone, step)
        metrics = made.update(step)
        loss, error, divergence = alone._vae.losses(batch.observations, batch.actions, drawn["vae"])
        descend(alone._optimizers["vae"], loss)
        assert torch.equal(metrics["vae/reconstruction_error"], error)
        assert torch.equal(metrics["vae/divergence"], divergence)
    for ours, theirs in zip(made._vae.parameters(), alone._vae.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.slow(2)
def test_matching_alone_brings_the_actor_to_the_log() -> None:
    log = make_log(episodes=20, explore=1.0)
    actions = (0.1 * log.actions + np.array([0.6, -0.6, 0.0])).astype(np.float32)
    log = relabelled(log, actions=actions)
    sizes = {"hidden": (32,), "vae_hidden": (32,), "batch": 64}
    rates = {"actor_learning_rate": 3e-3, "learning_rate": 3e-3}
    made = learner("bear", [log], [0], updates=300, warm_up=1.0, sigma=1.0, **sizes, **rates)
    apart = [metrics["actor/discrepancy"].item() for metrics in run(made, 300)]
    # three seeds measured 0.85 to 0.88 at first and 0.19 to 0.21 at last
    assert apart[0] > 0.7
    assert np.mean(apart[-50:]) < 0.3
    mean, log_std = made._actor(made._data.observations(torch.arange(200)[None]))
    # measured within 0.05; a learning rate of 0 would leave the first two near 0
    acted = torch.tanh(mean)[0].mean(dim=0).tolist()
    assert acted == pytest.approx([0.6, -0.6, 0.0], abs=0.15)
    assert log_std.exp().mean() < 0.3  # as narrow as the log's 0.1; 1 before, measured 0.01


def test_deployed_policy_is_described_by_its_card() -> None:
    card = small(deployed_actions=7).policy(policy_card()).card
    assert (card.kind, card.candidates, card.noise) == ("gaussian_candidates", 7, 3)


def test_settings_are_the_recommended_ports() -> None:
    settings = bear.Config()
    assert (settings.hidden, settings.vae_hidden) == ((256, 256), (750, 750))
    assert (settings.actor_learning_rate, settings.learning_rate) == (1e-4, 3e-4)
    assert (settings.batch, settings.target_rate, settings.minimum_weight) == (256, 0.005, 0.75)
    assert (settings.threshold, settings.kernel, settings.sigma) == (0.05, "laplacian", 20.0)
    counts = settings.matched_actions, settings.target_actions, settings.deployed_actions
    assert counts == (4, 10, 100)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"matched_actions": 0}, "matched_actions, target_actions and"),
        ({"discount": 1.0}, "discount must lie in"),
        ({"target_rate": 0.0}, "target_rate in"),
        ({"multiplier_learning_rate": 0.0}, "learning rates, sigma"),
        ({"sigma": 0.0}, "sigma, threshold and raw_limit must be positive"),
        ({"warm_up": 1.5}, "warm_up and minimum_weight must lie in"),
        ({"kernel": "linear"}, "kernel must be laplacian or gaussian, got 'linear'"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config("bear"), **changes)
