"""The learner that acts: its update against plain torch code, its episodes, its lanes."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from components.core.random_streams import lane_key
from components.experts.config import ExpertConfig
from components.experts.online import OnlineLearner
from components.experts.replay import Replay
from components.networks import StackedMLP
from tests.components.data.sources.toy_robot import LIMIT, ToyRobot

CPU = torch.device("cpu")
TINY = ExpertConfig(
    steps=90,
    random_steps=30,
    horizon=20,
    evaluate_every=30,
    episodes=3,
    hidden=(16, 12),
    batch=16,
    learning_rate=3e-3,
    target_rate=0.1,
)


def keys(*seeds: int) -> list[int]:
    return [lane_key("toy", seed) for seed in seeds]


def learner(*seeds: int, config: ExpertConfig = TINY, unsteady: float = 0.6) -> OnlineLearner:
    replay = Replay(len(seeds), config.steps, 3, 2, CPU)
    return OnlineLearner(config, keys(*seeds), ToyRobot(len(seeds), unsteady), replay, CPU)


def lived(made: OnlineLearner, lane: int) -> dict[str, np.ndarray]:
    """All transitions of a lane."""
    index = torch.arange(made._replay.count).expand(made.lanes, -1)
    batch = made._replay.batch(index)
    return {f.name: getattr(batch, f.name)[lane].numpy() for f in dataclasses.fields(batch)}


def plain(stack: StackedMLP) -> nn.Sequential:
    """Lane 0 of a stack as anyone would write it."""
    layers: list[nn.Module] = []
    for weight, bias in stack.affine():
        linear = nn.Linear(*weight.shape[1:])
        with torch.no_grad():
            linear.weight.copy_(weight[0].T)
            linear.bias.copy_(bias[0, 0])
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def test_one_step_equals_plain_code_of_the_method() -> None:
    made = learner(3)
    for step in range(TINY.random_steps):
        assert made.update(step) == {}
    before = {
        "actor": plain(made._learner._actor),
        "critic": plain(made._learner._critic.stack),
        "actor_target": plain(made._learner._actor_target),
        "critic_target": plain(made._learner._critic_target.stack),
    }
    robots, frame = copy.deepcopy(made._robots), made._frames.copy()
    random = {name: value.clone() for name, value in made._streams.at(TINY.random_steps).items()}
    made.update(TINY.random_steps)

    # acting
    with torch.no_grad():
        wanted = torch.tanh(before["actor"](torch.from_numpy(frame).float()))
    noisy = (wanted + TINY.exploration * random["noise"]).clamp(-1.0, 1.0)
    seen = lived(made, 0)
    np.testing.assert_allclose(seen["actions"][-1], noisy[0], atol=1e-6)  # float32
    frames, rewards = robots.step(seen["actions"][-1:].astype(np.float64))
    np.testing.assert_array_equal(seen["observations"][-1], frame[0].astype(np.float32))
    np.testing.assert_array_equal(seen["next_observations"][-1], frames[0].astype(np.float32))
    assert seen["rewards"][-1] == np.float32(rewards[0])

    # the update, on a batch from all transitions, the newest one included
    row = made._learner._streams.at(TINY.random_steps)["row"]
    rows = np.floor(row[0].numpy() * (TINY.random_steps + 1)).astype(int)
    batch = {name: torch.from_numpy(values[rows]) for name, values in seen.items()}

    def value(name: str, x: Tensor, actions: Tensor) -> Tensor:
        return before[name](torch.cat([x, actions], dim=1)).squeeze(1)

    slow = {name: copy.deepcopy(before[name]) for name in ("actor_target", "critic_target")}
    with torch.no_grad():
        after = batch["next_observations"]
        bootstrap = value("critic_target", after, torch.tanh(before["actor_target"](after)))
        target = batch["rewards"] + TINY.discount * batch["continues"] * bootstrap
    for name in ("critic", "actor"):
        adam = torch.optim.Adam(before[name].parameters(), lr=TINY.learning_rate)
        if name == "critic":
            fit = value("critic", batch["observations"], batch["actions"])
            loss = (fit - target).square().mean()
        else:
            own = torch.tanh(before["actor"](batch["observations"]))
            loss = -value("critic", batch["observations"], own).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    for name, stack in (("actor", made._learner._actor), ("critic", made._learner._critic.stack)):
        online, mine = before[name].parameters(), plain(stack).parameters()
        for expected, ours in zip(online, mine, strict=True):
            # one Adam step of 3e-3 from gradients in float32
            torch.testing.assert_close(ours, expected, rtol=1e-3, atol=3e-5)
    moved = plain(made._learner._critic_target.stack).parameters()
    parts = zip(moved, slow["critic_target"].parameters(), before["critic"].parameters())  # noqa: B905
    for ours, old, new in parts:
        torch.testing.assert_close(ours, 0.9 * old + 0.1 * new, rtol=1e-3, atol=3e-5)


def test_first_actions_are_uniform_and_later_ones_are_the_policy_with_noise() -> None:
    config = dataclasses.replace(TINY, steps=700, random_steps=500, learning_rate=1e-9)
    made = learner(0, config=config)
    for step in range(config.steps):
        made.update(step)
    seen = lived(made, 0)
    uniform = seen["actions"][:500]
    # five standard errors: 1,000 values of deviation 1 / sqrt(3); of squares, 2 / (3 sqrt(5))
    assert abs(uniform.mean()) < 5 * 0.577 / 1000**0.5
    assert abs((uniform**2).mean() - 1 / 3) < 5 * 0.298 / 1000**0.5
    # at a vanishing learning rate the policy has not moved
    with torch.no_grad():
        x = torch.from_numpy(seen["observations"][500:])
        noise = seen["actions"][500:] - torch.tanh(made.actor(x[None]))[0].numpy()
    inside = noise[np.abs(seen["actions"][500:]) < 1.0]
    assert inside.size > 300
    # five standard errors of a deviation from 300 values
    assert inside.std() == pytest.approx(0.1, rel=5 / (2 * 300) ** 0.5)
    assert np.abs(seen["actions"]).max() <= 1.0


def test_falls_are_terminal_and_the_end_of_time_is_not() -> None:
    made = learner(0, 1, unsteady=0.3)
    for step in range(TINY.steps):
        made.update(step)
    ends = {"falls": 0, "time": 0}
    for lane in range(2):
        seen = lived(made, lane)
        fallen = np.abs(seen["next_observations"][:, 2]) > LIMIT
        np.testing.assert_array_equal(seen["continues"] == 0.0, fallen)
        length = 0
        for n in range(TINY.steps - 1):
            length += 1
            goes_on = np.array_equal(seen["observations"][n + 1], seen["next_observations"][n])
            assert goes_on == (not fallen[n] and length < TINY.horizon)
            if not goes_on:
                assert np.abs(seen["observations"][n + 1]).max() <= 0.1  # a fresh start
                ends["falls" if fallen[n] else "time"] += 1
                length = 0
    assert min(ends.values()) > 0


def test_a_lane_lives_what_it_lives_alone() -> None:
    stack, alone = learner(4, 7, 9), learner(7)
    for step in range(60):
        stack.update(step)
        alone.update(step)
    together, single = lived(stack, 1), lived(alone, 0)
    for name, values in single.items():
        # thirty updates; stacked and single products may sum in another order
        np.testing.assert_allclose(together[name], values, rtol=1e-3, atol=1e-4)
    assert not np.allclose(lived(stack, 0)["rewards"], single["rewards"])
    for ours, theirs in zip(stack.actor.parameters(), alone.actor.parameters(), strict=True):
        torch.testing.assert_close(ours[1], theirs[0], rtol=1e-2, atol=1e-3)


def test_the_best_policy_is_kept_lane_by_lane() -> None:
    made = learner(0, 1)
    first = [p.detach().clone() for p in made.actor.parameters()]
    made.keep_best(30, torch.tensor([1.0, 5.0], dtype=torch.float64))
    with torch.no_grad():
        for parameter in made.actor.parameters():
            parameter += 1.0
    made.keep_best(60, torch.tensor([2.0, 4.0], dtype=torch.float64))
    assert (made.best_return, made.best_step) == ([2.0, 5.0], [60, 30])
    for kept, old in zip(made.best.parameters(), first, strict=True):
        torch.testing.assert_close(kept[0], old[0] + 1.0)
        assert torch.equal(kept[1], old[1])


def test_a_broken_lane_stands_still() -> None:
    made = learner(0, 1)
    for step in range(TINY.random_steps):
        made.update(step)
    with torch.no_grad():
        made.actor.affine()[0][0][0] = torch.nan
    made.update(TINY.random_steps)
    assert lived(made, 0)["actions"][-1].tolist() == [0.0, 0.0]
    assert np.isfinite(made._frames).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon, evaluate_every and episodes must be at least 1"),
        ({"random_steps": 91}, "from 1 to steps=90"),
        ({"evaluate_every": 91}, "no policy would be evaluated"),
        ({"exploration": -0.1}, "exploration is -0.1"),
        ({"discount": 1.0}, "discount must lie in"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TINY, **changes)


def test_default_settings_are_those_of_the_reference() -> None:
    config = ExpertConfig()
    assert (config.steps, config.random_steps, config.exploration) == (1_000_000, 25_000, 0.1)
    assert (config.hidden, config.batch, config.learning_rate) == ((400, 300), 100, 1e-3)
    assert (config.discount, config.target_rate, config.horizon) == (0.99, 0.005, 1000)
