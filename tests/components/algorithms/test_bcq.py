"""BCQ: candidates, targets and losses against plain loops, and a world where it must stay home."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms import bcq
from components.algorithms.parts.learner import descend
from components.data.batches import Batch
from components.data.dataset import OfflineDataset
from components.networks import StackedMLP
from tests.components.algorithms.plain import critic, floats, network, slopes
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
BOLD = {"learning_rate": 0.05, "perturbation": 0.4}  # so that order and perturbation show


def small(lanes: int = 2, **changes: object) -> bcq.Learner:
    """Learners whose networks are all different, targets included."""
    changes = {"batch": BATCH} | changes
    logs = [with_a_terminal()] * lanes
    return scattered(learner("bcq", logs, list(range(lanes)), **changes), 0.2)


def generated(made: bcq.Learner, lane: int, seen: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """One action of the autoencoder."""
    latent = [min(max(z, -0.5), 0.5) for z in noise]
    return np.tanh(network(made._vae.decoder, lane, np.concatenate([seen, latent])[None])[0])


def perturbed(
    made: bcq.Learner, stack: StackedMLP, lane: int, seen: np.ndarray, action: np.ndarray
) -> np.ndarray:
    moved = network(stack, lane, np.concatenate([seen, action])[None])[0]
    return np.clip(action + made._config.perturbation * np.tanh(moved), -1.0, 1.0)


def expected_targets(made: bcq.Learner, batch: Batch, noise: Tensor, lane: int) -> list[float]:
    """r + gamma (1 - terminal) times the best of the candidates' mixed target values."""
    targets, stack = [], made._critics_target.stack
    for i in range(batch.rewards.shape[1]):
        following, mixed = floats(batch.next_observations)[lane, i], []
        for z in floats(noise)[lane, i]:
            action = generated(made, lane, following, z)
            action = perturbed(made, made._actor_target, lane, following, action)
            twins = [critic(stack, 2 * lane + j, following, action) for j in range(2)]
            mixed.append(0.75 * min(twins) + 0.25 * max(twins))
        alive = floats(batch.continues)[lane, i]
        targets.append(batch.rewards[lane, i].item() + 0.97 * alive * max(mixed))
    return targets


def expected_actor_loss(made: bcq.Learner, batch: Batch, noise: Tensor, lane: int) -> float:
    """Minus the first critic's mean value at one perturbed generated action per state."""
    values = []
    for i in range(BATCH):
        seen = floats(batch.observations)[lane, i]
        action = generated(made, lane, seen, floats(noise)[lane, i, 0])
        action = perturbed(made, made._actor, lane, seen, action)
        values.append(critic(made._critics.stack, 2 * lane, seen, action))
    return -float(np.mean(values))


def first_gradient(made: bcq.Learner, name: str, bias: Tensor) -> Tensor:
    """What Adam has seen in its only step: its first moment is a tenth of it."""
    return made._optimizers[name].state[bias]["exp_avg"] / 0.1


def moved(made: bcq.Learner, before: dict[str, Tensor]) -> set[str]:
    after = made.state_dict()
    return {
        name.split(".")[0]
        for name, old in before.items()
        if "optimizer" not in name and not torch.equal(after[name], old)
    }


def state_of(made: bcq.Learner) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in made.state_dict().items()}


def test_targets_by_hand_stop_at_terminals_alone() -> None:
    made = small(perturbation=0.4, target_actions=5)
    _, drawn = drawn_by(made)
    rows = torch.tensor([[STEPS - 1, 2 * STEPS - 1, 3, 100]] * 2)
    batch = made._data.batch(rows)
    assert batch.continues.tolist() == [[1.0, 0.0, 1.0, 1.0]] * 2  # a time-out goes on
    targets = made._targets(batch, drawn["target"])
    assert drawn["target"].shape == (2, BATCH, 5, 6)
    assert (drawn["target"].abs() > 0.5).any()
    for lane in range(2):
        expected = expected_targets(made, batch, drawn["target"], lane)
        assert targets[lane].tolist() == pytest.approx(expected, **CLOSE)
        assert targets[lane, 1] == batch.rewards[lane, 1]


def test_one_update_by_hand() -> None:
    made, now = small(**BOLD), small(**BOLD)
    batch, drawn = drawn_by(made)
    stale = [expected_targets(now, batch, drawn["target"], lane) for lane in range(2)]
    metrics = made.update(0)
    now._vae.load_state_dict(made._vae.state_dict())  # the autoencoder is the first to step
    for lane in range(2):
        targets = expected_targets(now, batch, drawn["target"], lane)
        assert metrics["critic/target_mean"][lane].item() == pytest.approx(
            np.mean(targets), **CLOSE
        )
        assert np.abs(np.subtract(targets, stale[lane])).max() > 0.01
        loss = 0.0
        for j in range(2):
            pairs = np.concatenate([floats(batch.observations), floats(batch.actions)], axis=-1)
            errors = network(now._critics.stack, 2 * lane + j, pairs[lane])[:, 0] - targets
            loss += np.mean(errors**2)
            _, bias = made._critics.stack.affine()[-1]
            gradient = first_gradient(made, "critics", bias)[2 * lane + j].item()
            assert gradient == pytest.approx(2.0 * np.mean(errors), **CLOSE)
        assert metrics["critic/loss"][lane].item() == pytest.approx(loss, **CLOSE)
    stale = [expected_actor_loss(now, batch, drawn["actor"], lane) for lane in range(2)]
    now._critics.load_state_dict(made._critics.state_dict())  # then the critics, then the actor
    now._actor.double()
    for lane in range(2):
        expected = expected_actor_loss(now, batch, drawn["actor"], lane)
        assert metrics["actor/loss"][lane].item() == pytest.approx(expected, **CLOSE)
        assert abs(expected - stale[lane]) > 0.01
        own = now._actor.affine()[-1][1].data[lane, 0]
        climbed = slopes(lambda n=lane: expected_actor_loss(now, batch, drawn["actor"], n), own)
        assert max(abs(slope) for slope in climbed) > 1e-3
        gradient = first_gradient(made, "actor", made._actor.affine()[-1][1])[lane, 0]
        assert gradient.tolist() == pytest.approx(climbed, rel=1e-3, abs=1e-6)  # float32


def test_every_network_moves_and_targets_by_tau() -> None:
    made = small(target_rate=0.2)
    for step in range(2):
        before = state_of(made)
        made.update(step)
        assert moved(made, before) == {"vae", "critics", "actor", "critics_target", "actor_target"}
        after = made.state_dict()
        slow = [name for name in before if "_target." in name and "optimizer" not in name]
        assert slow
        for name in slow:
            online = after[name.replace("_target", "")]
            # two roundings in float32
            torch.testing.assert_close(
                after[name], 0.8 * before[name] + 0.2 * online, rtol=1e-6, atol=1e-7
            )


def test_the_actors_loss_moves_the_actor_alone() -> None:
    made = small()
    batch, drawn = drawn_by(made)
    before = state_of(made)
    loss, _ = made._actor_loss(batch, drawn["actor"])
    descend(made._optimizers["actor"], loss)
    assert moved(made, before) == {"actor"}


def test_the_autoencoder_learns_as_if_it_were_alone() -> None:
    made, alone = small(), small()
    for step in range(3):
        batch, drawn = drawn_by(alone, step)
        metrics = made.update(step)
        loss, error, divergence = alone._vae.losses(batch.observations, batch.actions, drawn["vae"])
        descend(alone._optimizers["vae"], loss)
        assert torch.equal(metrics["vae/reconstruction_error"], error)
        assert torch.equal(metrics["vae/divergence"], divergence)
    for ours, theirs in zip(made._vae.parameters(), alone._vae.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("bound", [0.0, 0.05, 0.4])
def test_perturbations_reach_their_bound_and_never_pass_it(bound: float) -> None:
    made = small(perturbation=bound)
    x = made._data.observations(torch.arange(50).expand(2, -1))
    raw = torch.linspace(-0.9, 0.9, 7)[:, None].expand(2, 50, 7, 3)
    shift = (made._perturb(made._actor, x, raw) - raw).abs()
    assert shift.max().item() <= bound + 1e-6  # float32
    assert bool(shift.any()) == (bound > 0.0)
    with torch.no_grad():
        made._actor.affine()[-1][1].copy_(torch.tensor([100.0, -100.0, 100.0]))
    moved_to = made._perturb(made._actor, x, raw)
    expected = (raw + bound * torch.tensor([1.0, -1.0, 1.0])).clamp(-1.0, 1.0)
    torch.testing.assert_close(moved_to, expected)
    # 0.9 + 0.4 leaves the box
    assert bool((moved_to.abs() == 1.0).any()) == (bound == 0.4)


def test_targets_weigh_the_least_critic_by_the_setting() -> None:
    made = small(minimum_weight=0.0, target_actions=1)
    cautious = small(minimum_weight=1.0, target_actions=1)
    batch, drawn = drawn_by(made)
    high, low = (m._targets(batch, drawn["target"]) for m in (made, cautious))
    assert (high > low).all()
    mixed = small(minimum_weight=0.75, target_actions=1)._targets(batch, drawn["target"])
    torch.testing.assert_close(mixed, 0.75 * low + 0.25 * high, rtol=1e-5, atol=1e-5)  # float32


def test_deployed_policy_is_described_by_its_card() -> None:
    card = small(deployed_actions=7, perturbation=0.1).policy(policy_card()).card
    assert (card.kind, card.candidates, card.noise, card.perturbation) == (
        "perturbed_candidates",
        7,
        6,
        0.1,
    )


def two_ways_to_act() -> OfflineDataset:
    """A log of first entries near +-0.6, by a coin, whose rewards are the first entries."""
    log = make_log(episodes=20, explore=1.0)
    actions = 0.1 * log.actions
    actions[:, 0] += 0.6 * np.sign(np.random.default_rng(0).normal(size=len(actions)))
    actions = actions.astype(np.float32)
    ends = np.ones(log.transitions, dtype=np.bool_)
    return relabelled(log, actions=actions, rewards=actions[:, 0].copy(), terminated=ends)


@pytest.mark.slow(2)
def test_it_chooses_the_better_of_the_logged_ways_and_goes_no_further() -> None:
    log = two_ways_to_act()
    sizes = {"hidden": (32,), "vae_hidden": (32,), "batch": 64, "deployed_actions": 20}
    made = learner("bcq", [log], [0], learning_rate=3e-3, **sizes)
    run(made, 400)
    policy = made.policy(policy_card(log))
    histories = made._data.raw_histories(torch.arange(200)[None])
    noise = torch.randn(1, 200, 20, 6, generator=torch.Generator().manual_seed(0))
    acted = policy.act(histories, noise=noise)[0]
    # a clone would do neither, mean 0; three seeds measured 0.34 to 0.45, and at most 0.58
    assert acted[:, 0].mean() > 0.25
    assert acted.abs().max() < 0.7 + 0.05 + 0.05  # the log's bound, the perturbation, a margin


def test_settings_are_the_authors_current_ones() -> None:
    settings = bcq.Config()
    assert (settings.hidden, settings.vae_hidden) == ((400, 300), (750, 750))
    assert (settings.learning_rate, settings.batch, settings.target_rate) == (1e-3, 100, 0.005)
    assert (settings.perturbation, settings.minimum_weight) == (0.05, 0.75)
    assert (settings.target_actions, settings.deployed_actions) == (10, 100)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target_actions": 0}, "target_actions and deployed_actions must be at least 1"),
        ({"vae_hidden": (0,)}, "vae_hidden"),
        ({"discount": 0.0}, "discount must lie in"),
        ({"target_rate": 1.5}, "target_rate in"),
        ({"perturbation": -0.1}, "perturbation not negative"),
        ({"minimum_weight": 1.1}, "minimum_weight lie in"),
        ({"learning_rate": -1.0}, "learning_rate must be positive"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config("bcq"), **changes)
