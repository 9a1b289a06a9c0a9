"""Online TD3: its update against plain torch code, and its place in plans."""

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from components.core.random_streams import lane_key
from components.experts.config import ExpertConfig
from components.experts.online import OnlineLearner
from components.experts.replay import Replay
from components.networks import StackedMLP
from flows.configuration.settings import SettingsError, load_settings
from flows.planning.experts import expert_plan
from tests.components.data.sources.toy_robot import ToyRobot

CONFIG = ExpertConfig(
    method="td3",
    steps=90,
    random_steps=31,  # so that the first update leaves the actor alone
    horizon=20,
    evaluate_every=30,
    hidden=(16, 12),
    batch=16,
    learning_rate=3e-3,
    target_rate=0.1,
)


def learner() -> OnlineLearner:
    cpu = torch.device("cpu")
    replay = Replay(1, CONFIG.steps, 3, 2, cpu)
    return OnlineLearner(CONFIG, [lane_key("toy", 3)], ToyRobot(1, 0.6), replay, cpu)


def plain(stack: StackedMLP, place: int) -> nn.Sequential:
    """One network of a stack as anyone would write it."""
    layers: list[nn.Module] = []
    for weight, bias in stack.affine():
        linear = nn.Linear(*weight.shape[1:])
        with torch.no_grad():
            linear.weight.copy_(weight[place].T)
            linear.bias.copy_(bias[place, 0])
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def value(critic: nn.Module, seen: Tensor, actions: Tensor) -> Tensor:
    out: Tensor = critic(torch.cat([seen, actions], dim=1)).squeeze(1)
    return out


def moved(slow: nn.Module, fast: nn.Module) -> None:
    with torch.no_grad():
        for s, f in zip(slow.parameters(), fast.parameters(), strict=True):
            s.lerp_(f, CONFIG.target_rate)


def test_four_steps_equal_plain_code_of_the_method() -> None:
    made = learner()
    for step in range(CONFIG.random_steps):
        assert made.update(step) == {}
    ours = made._learner
    actor = plain(ours.actor, 0)
    critics = [plain(ours._critics.stack, place) for place in (0, 1)]
    slow_actor, slow_critics = copy.deepcopy(actor), copy.deepcopy(critics)
    actor_adam = torch.optim.Adam(actor.parameters(), lr=CONFIG.learning_rate)
    weights = [p for critic in critics for p in critic.parameters()]
    critic_adam = torch.optim.Adam(weights, lr=CONFIG.learning_rate)
    started = copy.deepcopy(actor)
    for step in range(CONFIG.random_steps, CONFIG.random_steps + 4):
        metrics = made.update(step)
        drawn = ours._streams.at(step)
        # rows among all transitions so far, this step's included
        batch = made._replay.batch((drawn["row"] * (step + 1)).long())
        seen, after = batch.observations[0], batch.next_observations[0]
        with torch.no_grad():
            smoothing = (0.2 * drawn["noise"][0]).clamp(-0.5, 0.5)
            following = (torch.tanh(slow_actor(after)) + smoothing).clamp(-1, 1)
            least = torch.minimum(*(value(critic, after, following) for critic in slow_critics))
            target = batch.rewards[0] + CONFIG.discount * batch.continues[0] * least
        fits = [value(critic, seen, batch.actions[0]) for critic in critics]
        loss = sum((fit - target).square().mean() for fit in fits)
        critic_adam.zero_grad()
        loss.backward()
        critic_adam.step()
        assert metrics["critic/loss"].item() == pytest.approx(loss.item(), rel=1e-4)  # float32
        acts = step % 2 == 1  # every second update
        assert ("actor/loss" in metrics) == acts
        if not acts:
            continue
        actor_loss = -value(critics[0], seen, torch.tanh(actor(seen))).mean()
        actor_adam.zero_grad()
        actor_loss.backward()
        actor_adam.step()
        moved(slow_actor, actor)
        for slow, fast in zip(slow_critics, critics, strict=True):
            moved(slow, fast)
    pairs = [(plain(ours.actor, 0), actor), (plain(ours._actor_target, 0), slow_actor)]
    pairs += [(plain(ours._critics.stack, j), critics[j]) for j in (0, 1)]
    pairs += [(plain(ours._critics_target.stack, j), slow_critics[j]) for j in (0, 1)]
    for mine, expected in pairs:
        for a, b in zip(mine.parameters(), expected.parameters(), strict=True):
            # four Adam steps of 3e-3 from gradients in float32
            torch.testing.assert_close(a, b, rtol=1e-3, atol=3e-5)
    first = next(started.parameters())
    assert not torch.allclose(next(pairs[0][0].parameters()), first)


def test_the_default_method_keeps_the_identity_of_earlier_trainings(tmp_path: Path) -> None:
    def configs(*words: str) -> list[dict]:
        words = ("profile=smoke", "experts.robots=[hopper]", f"store={tmp_path}", *words)
        return [dict(node.config["training"]) for node in expert_plan(load_settings(list(words)))]

    assert all("method" not in config for config in configs())
    assert all(config["method"] == "td3" for config in configs("experts.training.method=td3"))


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(SettingsError, match="method is 'sac'; give one of ddpg, td3"):
        load_settings(["experts.training.method=sac"])
    with pytest.raises(ValueError, match="target_rate"):
        dataclasses.replace(CONFIG, target_rate=0.0)
