"""DDPG against plain torch code, and unleashed where nothing holds it."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from components.algorithms import ddpg
from components.data.batches import Batch
from components.data.dataset import OfflineDataset
from components.networks import StackedMLP
from tests.components.algorithms.plain import critic, floats, network
from tests.components.algorithms.stacks import config, learner, run, scattered
from tests.components.synthetic import make_log, policy_card, relabelled

STEPS = 40


def with_some_terminals() -> OfflineDataset:
    """Every seventh transition ends in a terminal state, the second episode's last one too."""
    log = make_log()
    terminated = np.zeros(log.transitions, dtype=np.bool_)
    terminated[::7] = terminated[2 * STEPS - 1] = True
    return relabelled(log, terminated=terminated, truncated=log.truncated & ~terminated)


def small(lanes: int = 2, **changes: object) -> ddpg.Learner:
    """Learners whose networks are all different, targets included."""
    made = learner("ddpg", [with_some_terminals()] * lanes, list(range(lanes)), **changes)
    return scattered(made, 0.2)


def plain_network(stack: StackedMLP, lane: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for weight, bias in stack.affine():
        linear = nn.Linear(*weight.shape[1:])
        with torch.no_grad():
            linear.weight.copy_(weight[lane].T)
            linear.bias.copy_(bias[lane, 0])
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def networks_of(made: ddpg.Learner, lane: int) -> dict[str, nn.Sequential]:
    stacks = {
        "actor": made._actor,
        "critic": made._critic.stack,
        "actor_target": made._actor_target,
        "critic_target": made._critic_target.stack,
    }
    return {name: plain_network(stack, lane) for name, stack in stacks.items()}


class PlainDDPG:
    """The algorithm as anyone would write it, for one lane."""

    def __init__(self, made: ddpg.Learner, lane: int) -> None:
        self.settings: Any = made._config
        self.networks = networks_of(made, lane)
        rate = self.settings.learning_rate
        self.adam = {
            name: torch.optim.Adam(self.networks[name].parameters(), lr=rate)
            for name in ("actor", "critic")
        }

    def value(self, name: str, seen: Tensor, actions: Tensor) -> Tensor:
        return self.networks[name](torch.cat([seen, actions], dim=1)).squeeze(1)

    def step(self, name: str, loss: Tensor) -> None:
        self.adam[name].zero_grad()
        loss.backward()
        self.adam[name].step()

    def update(self, batch: Batch, lane: int) -> dict[str, float]:
        seen, after = batch.observations[lane], batch.next_observations[lane]
        with torch.no_grad():
            following = torch.tanh(self.networks["actor_target"](after))
            bootstrap = self.value("critic_target", after, following)
            target = batch.rewards[lane] + self.settings.discount * bootstrap * (
                batch.continues[lane] > 0
            )
        error = (self.value("critic", seen, batch.actions[lane]) - target).square().mean()
        self.step("critic", error)
        values = self.value("critic", seen, torch.tanh(self.networks["actor"](seen)))
        self.step("actor", -values.mean())
        with torch.no_grad():
            for name in ("actor", "critic"):
                slow, fast = self.networks[f"{name}_target"], self.networks[name]
                for s, f in zip(slow.parameters(), fast.parameters(), strict=True):
                    s.copy_((1 - self.settings.target_rate) * s + self.settings.target_rate * f)
        return {
            "critic/loss": error.item(),
            "critic/target_mean": target.mean().item(),
            "critic/value_magnitude": values.abs().mean().item(),
            "actor/loss": -values.mean().item(),
        }


def test_five_updates_equal_plain_torch_code() -> None:
    made = small(target_rate=0.1, learning_rate=3e-3)  # large, so that a mistake would show
    plain = [PlainDDPG(made, lane) for lane in range(2)]
    for step in range(5):
        batch = made._data.batch(made._streams.at(step)["row"].clone())
        assert 0.0 < batch.continues.mean() < 1.0
        metrics = made.update(step)
        for lane, one in enumerate(plain):
            expected = one.update(batch, lane)
            assert metrics.keys() - expected.keys() == {"actor/saturated_share"}
            for name, value in expected.items():
                assert metrics[name][lane].item() == pytest.approx(value, rel=1e-3), name
    for lane, one in enumerate(plain):
        for name, ours in networks_of(made, lane).items():
            theirs = one.networks[name]
            for p, expected in zip(ours.parameters(), theirs.parameters(), strict=True):
                # five Adam steps of 3e-3 in float32
                torch.testing.assert_close(p, expected, rtol=1e-3, atol=3e-5)


def test_a_time_out_is_bootstrapped_and_a_terminal_is_not() -> None:
    made = small()
    last = torch.tensor([[STEPS - 1, 2 * STEPS - 1, 4]] * 2)
    batch = made._data.batch(last)
    assert batch.continues.tolist() == [[1.0, 0.0, 1.0]] * 2
    targets = made._targets(batch)
    for lane, i in np.ndindex(2, 3):
        following = floats(batch.next_observations)[lane, i]
        action = np.tanh(network(made._actor_target, lane, following[None])[0])
        value = critic(made._critic_target.stack, lane, following, action)
        expected = batch.rewards[lane, i].item() + (0.0 if i == 1 else 0.97 * value)
        assert abs(value) > 0.01
        # float32 sums of 18 products
        assert targets[lane, i].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_the_actor_climbs_the_critic_just_updated() -> None:
    made, before = small(learning_rate=0.05), small(learning_rate=0.05)
    metrics = made.update(0)
    batch = made._data.batch(made._streams.at(0)["row"])
    for lane in range(2):
        seen = floats(batch.observations)[lane]
        pairs = np.concatenate([seen, np.tanh(network(before._actor, lane, seen))], axis=1)
        loss = metrics["actor/loss"][lane].item()
        # float32
        assert loss == pytest.approx(-network(made._critic.stack, lane, pairs).mean(), rel=1e-4)
        assert abs(loss + network(before._critic.stack, lane, pairs).mean()) > 0.1


def test_every_network_moves_in_every_update_and_targets_by_tau() -> None:
    made = small(target_rate=0.2)
    for step in range(2):
        before = {k: v.clone() for k, v in made.state_dict().items() if "optimizer" not in k}
        made.update(step)
        after = made.state_dict()
        for name, old in before.items():
            assert not torch.equal(after[name], old), name
            if "target" in name:
                online = after[name.replace("_target", "")]
                # two roundings in float32
                torch.testing.assert_close(
                    after[name], 0.8 * old + 0.2 * online, rtol=1e-6, atol=1e-7
                )


def test_nothing_holds_the_actor_near_the_log() -> None:
    # The reward is the action's first entry; the log never leaves +-0.3.
    log = make_log(episodes=20, explore=1.0)
    actions = (0.3 * log.actions).astype(np.float32)
    ends = np.ones(log.transitions, dtype=np.bool_)
    log = relabelled(log, actions=actions, rewards=actions[:, 0].copy(), terminated=ends)
    made = learner("ddpg", [log], [0], learning_rate=3e-3, batch=64, hidden=(32,))
    metrics = run(made, 400)
    histories = made._data.raw_histories(torch.arange(200)[None])
    acted = made.policy(policy_card(log)).act(histories)[0]
    # measured 0.9996, and a share of 0.85
    assert acted[:, 0].mean() > 0.9
    assert metrics[-1]["actor/saturated_share"].item() > 0.3


def test_settings_are_the_newer_authors_ones() -> None:
    settings = ddpg.Config()
    assert settings.hidden == (256, 256)
    assert (settings.learning_rate, settings.batch, settings.target_rate) == (3e-4, 256, 0.005)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch": 0}, "batch and hidden must be at least 1"),
        ({"hidden": (8, 0)}, "batch and hidden must be at least 1"),
        ({"discount": 1.0}, "discount must lie in"),
        ({"target_rate": 0.0}, "target_rate in"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config("ddpg"), **changes)
