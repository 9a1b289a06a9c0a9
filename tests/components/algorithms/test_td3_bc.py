"""TD3+BC against plain torch code, and in worlds whose values are known."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from components.data.dataset import OfflineDataset
from tests.components.algorithms.stacks import config, learner, run
from tests.components.synthetic import make_log, policy_card, relabelled

HISTORY, STEPS = 3, 40


def with_some_terminals() -> OfflineDataset:
    log = make_log()
    terminated = np.zeros(log.transitions, dtype=np.bool_)
    terminated[::7] = True
    return relabelled(log, terminated=terminated)


def plain_batch(log: OfflineDataset, rows: Tensor) -> tuple[Tensor, ...]:
    """Transitions gathered one by one: observations, actions, rewards, next ones, continues."""
    mean = log.frames.mean(axis=0, dtype=np.float64)
    deviation = log.frames.std(axis=0, dtype=np.float64) + 1e-3
    deviation[0] = 1.0  # the setpoint never changes
    scaled = (log.frames - mean) / deviation
    now, after = [], []
    for row in rows.tolist():
        episode, step = divmod(row, STEPS)
        first = episode * (STEPS + 1)
        for store, newest in ((now, step), (after, step + 1)):
            frames = [scaled[first + max(newest - lag, 0)] for lag in range(HISTORY)]
            store.append(np.concatenate(frames))
    rows = rows.numpy()
    arrays = (
        np.stack(now),
        log.actions[rows],
        log.rewards[rows],
        np.stack(after),
        1.0 - log.terminated[rows],
    )
    return tuple(torch.from_numpy(np.asarray(a, dtype=np.float32)) for a in arrays)


def plain_network(state: dict[str, Tensor], name: str, lane: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    stack = f"{name}.stack" if name.startswith("critics") else name
    for number in range(2):
        weight = state[f"{stack}.layers.{number}.weight"][lane]
        layers += [nn.Linear(*weight.shape), nn.ReLU()]
        with torch.no_grad():
            layers[-2].weight.copy_(weight.T)
            layers[-2].bias.copy_(state[f"{stack}.layers.{number}.bias"][lane, 0])
    return nn.Sequential(*layers[:-1])


class PlainTD3BC:
    """The authors' algorithm as anyone would write it, for one lane."""

    def __init__(self, state: dict[str, Tensor], lane: int, settings: Any) -> None:
        self.settings = settings
        self.actor = plain_network(state, "actor", lane)
        self.critics = [plain_network(state, "critics", 2 * lane + j) for j in range(2)]
        self.actor_target = copy.deepcopy(self.actor)
        self.critics_target = copy.deepcopy(self.critics)
        rate = settings.learning_rate
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), lr=rate)
        weights = [p for critic in self.critics for p in critic.parameters()]
        self.critic_adam = torch.optim.Adam(weights, lr=rate)

    def update(self, step: int, batch: tuple[Tensor, ...], noise: Tensor) -> dict[str, float]:
        c = self.settings
        seen, taken, reward, after, alive = batch
        with torch.no_grad():
            smoothing = (c.smoothing * noise).clamp(-c.smoothing_clip, c.smoothing_clip)
            following = (torch.tanh(self.actor_target(after)) + smoothing).clamp(-1, 1)
            pair = torch.cat([after, following], dim=1)
            least = torch.minimum(*(critic(pair).squeeze(1) for critic in self.critics_target))
            target = reward + c.discount * alive * least
        pair = torch.cat([seen, taken], dim=1)
        loss = sum((critic(pair).squeeze(1) - target).square().mean() for critic in self.critics)
        self.critic_adam.zero_grad()
        loss.backward()
        self.critic_adam.step()
        metrics = {"critic/loss": loss.item(), "critic/target_mean": target.mean().item()}
        if step % 2 == 1:
            chosen = torch.tanh(self.actor(seen))
            value = self.critics[0](torch.cat([seen, chosen], dim=1)).squeeze(1)
            weight = c.alpha / value.abs().mean().detach()
            imitation = ((chosen - taken) ** 2).mean()
            actor_loss = -weight * value.mean() + imitation
            self.actor_adam.zero_grad()
            actor_loss.backward()
            self.actor_adam.step()
            pairs = [(self.actor_target, self.actor)]
            pairs += list(zip(self.critics_target, self.critics, strict=True))
            with torch.no_grad():
                for slow, fast in pairs:
                    for s, f in zip(slow.parameters(), fast.parameters(), strict=True):
                        s.copy_((1 - c.target_rate) * s + c.target_rate * f)
            metrics |= {"actor/loss": actor_loss.item(), "actor/imitation_error": imitation.item()}
        return metrics


def test_six_updates_equal_plain_torch_code() -> None:
    log = with_some_terminals()
    changes = {"target_rate": 0.1, "smoothing": 0.4}  # large, so that a mistake would show
    made = learner("td3_bc", [log] * 2, [0, 1], **changes)
    state = {k: v.clone() for k, v in made.state_dict().items()}
    plain = [PlainTD3BC(state, lane, config("td3_bc", **changes)) for lane in range(2)]
    for step in range(6):
        drawn = {k: v.clone() for k, v in made._streams.at(step).items()}
        metrics = made.update(step)
        for lane in range(2):
            batch = plain_batch(log, drawn["row"][lane])
            expected = plain[lane].update(step, batch, drawn["noise"][lane])
            assert metrics.keys() - expected.keys() <= {
                "critic/value_magnitude",
                "actor/saturated_share",
            }
            for name, value in expected.items():
                assert float(metrics[name][lane]) == pytest.approx(value, rel=1e-4), name
    after = made.state_dict()
    for lane, one in enumerate(plain):
        modules = {"actor": one.actor, "actor_target": one.actor_target}
        for name, module in modules.items():
            theirs = plain_network(after, name, lane)
            for ours, expected in zip(theirs.parameters(), module.parameters(), strict=True):
                # six Adam steps of 1e-3 in float32
                torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-5)
        for name, twins in (("critics", one.critics), ("critics_target", one.critics_target)):
            for j, critic in enumerate(twins):
                theirs = plain_network(after, name, 2 * lane + j)
                for ours, expected in zip(theirs.parameters(), critic.parameters(), strict=True):
                    torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-5)


def test_a_time_out_is_bootstrapped_and_a_terminal_is_not() -> None:
    log = make_log()
    terminated = log.terminated.copy()
    terminated[2 * STEPS - 1] = True  # the second episode ends in a terminal state
    truncated = log.truncated & ~terminated
    made = learner("td3_bc", [relabelled(log, terminated=terminated, truncated=truncated)], [0])
    last = torch.tensor([[STEPS - 1, 2 * STEPS - 1, 3 * STEPS - 1]])
    batch = made._data.batch(last)
    assert batch.continues.tolist() == [[1.0, 0.0, 1.0]]
    targets = made._targets(batch, torch.zeros(1, 3, 3))
    bootstrapped = targets[0] != batch.rewards[0]
    assert bootstrapped.tolist() == [True, False, True]
    # what follows a time-out is the episode's last frame, not the next episode's first one
    scaling = made._data.frame_scaling
    newest = batch.next_observations[..., : len(log.card.frame_features)]
    torch.testing.assert_close(
        scaling.invert(newest)[0, 0], torch.from_numpy(log.frames[STEPS]), rtol=1e-4, atol=1e-4
    )


@pytest.mark.slow(2)
def test_without_weight_on_values_it_clones() -> None:
    log = make_log(episodes=20, explore=0.0)
    made = learner("td3_bc", [log], [0], alpha=0.0, learning_rate=3e-3, batch=64, hidden=(32,))
    metrics = run(made, 1000)
    errors = torch.stack([m["actor/imitation_error"] for m in metrics[1::2]])
    # measured 0.061 at first and 0.00005 at last
    assert errors[-50:].mean() < 0.005
    assert errors[0] > 0.05
    for m in metrics[1::2]:
        assert torch.equal(m["actor/loss"], m["actor/imitation_error"])


@pytest.mark.slow(2)
def test_values_pull_the_actor_towards_rewarded_actions() -> None:
    # The reward is the action's first entry, the log's actions are uniform: Q rises with it.
    log = make_log(episodes=20, explore=1.0)
    rewards = log.actions[:, 0].copy()
    log = relabelled(log, rewards=rewards, terminated=np.ones(log.transitions, dtype=np.bool_))
    made = learner("td3_bc", [log], [0], learning_rate=3e-3, batch=64, hidden=(32,))
    run(made, 600)
    histories = made._data.raw_histories(torch.arange(200)[None])
    actions = made.policy(policy_card(log)).act(histories)[0]
    # imitation alone would end near 0 everywhere; measured means 0.99, -0.10, -0.09
    assert actions[:, 0].mean() > 0.7
    assert actions[:, 1:].mean(dim=0).abs().max() < 0.3


def test_actor_and_targets_move_every_second_update() -> None:
    made = learner("td3_bc", [make_log()], [0])
    for step in range(4):
        before = {k: v.clone() for k, v in made.state_dict().items()}
        metrics = made.update(step)
        moved = {
            name
            for name, tensor in made.state_dict().items()
            if "optimizer" not in name and not torch.equal(tensor, before[name])
        }
        networks = {name.split(".")[0] for name in moved}
        late = {"actor", "actor_target", "critics_target"} if step % 2 else set()
        assert networks == {"critics"} | late
        assert ("actor/loss" in metrics) == bool(step % 2)
