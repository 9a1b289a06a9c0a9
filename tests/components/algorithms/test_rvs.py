"""RvS-R: the returns it is conditioned on, its likelihood, and the dial that asks for a return."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from components.algorithms import rvs
from components.data.dataset import OfflineDataset
from tests.components.algorithms.plain import floats, network
from tests.components.algorithms.stacks import config, learner, run
from tests.components.synthetic import make_log, policy_card, relabelled

WINDOW, DISCOUNT = 10, 0.9


def of_unequal_lengths() -> OfflineDataset:
    """Two episodes of 25 steps, one too short for a window, one of exactly a window."""
    parts = [
        make_log(seed=1, episodes=2, steps=25),
        make_log(seed=2, episodes=1, steps=6),
        make_log(seed=3, episodes=1, steps=WINDOW),
    ]
    names = ("frames", "actions", "rewards", "terminated", "truncated")
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    log = dataclasses.replace(parts[0], episode_starts=np.array([0, 25, 50, 56, 66]))
    return relabelled(log, **arrays)


ROWS = [*range(16), *range(25, 41), 56]  # the starts of whole windows in that log


def windows_of(log: OfflineDataset) -> dict[int, float]:
    """Return of every whole window, reward by reward."""
    returns = {}
    for start, end in zip(log.episode_starts[:-1], log.episode_starts[1:], strict=True):
        for row in range(start, end):
            if row + WINDOW <= end:
                rewards = log.rewards[row : row + WINDOW].tolist()
                returns[row] = sum(DISCOUNT**k * reward for k, reward in enumerate(rewards))
    return returns


def small(logs: list[OfflineDataset], **changes: object) -> rvs.Learner:
    changes = {"window": WINDOW, "discount": DISCOUNT} | changes
    return learner("rvs", logs, list(range(len(logs))), **changes)


def standardised(log: OfflineDataset, value: float) -> float:
    returns = list(windows_of(log).values())
    return (value - float(np.mean(returns))) / float(np.std(returns))


def test_returns_equal_a_plain_loop_over_rewards() -> None:
    logs = [of_unequal_lengths(), make_log()]
    made = small(logs)
    for lane, log in enumerate(logs):
        returns = windows_of(log)
        if lane == 0:
            assert list(returns) == ROWS
        for row, value in returns.items():
            # standardised numbers of order 1 in float32
            expected = pytest.approx(standardised(log, value), abs=1e-4)
            assert made._returns[lane, row].item() == expected


def test_after_a_fall_nothing_is_earned_and_a_time_out_is_no_fall() -> None:
    log = of_unequal_lengths()
    terminated = np.zeros(log.transitions, dtype=np.bool_)
    terminated[[24, 55]] = True  # of the first episode and of the short one
    log = relabelled(log, terminated=terminated, truncated=log.truncated & ~terminated)
    rows, returns = rvs.achieved_returns(log, rvs.Config(window=WINDOW, discount=DISCOUNT))
    assert rows.tolist() == [*range(25), *range(25, 41), *range(50, 56), 56]
    ends = np.repeat(log.episode_starts[1:], np.diff(log.episode_starts))
    for row, found in zip(rows, returns, strict=True):
        rewards = log.rewards[row : min(row + WINDOW, ends[row])].tolist()
        expected = sum(DISCOUNT**k * reward for k, reward in enumerate(rewards))
        assert found == pytest.approx(expected)


def test_steps_without_a_whole_window_are_never_drawn() -> None:
    made = small([of_unequal_lengths()])
    drawn = torch.cat([made._streams.at(step)["row"].flatten() for step in range(100)])
    # 1,600 draws of 33 rows: the chance that one is missing is below 33 e^-48
    assert sorted(set(drawn.tolist())) == ROWS


def test_loss_is_the_negative_log_likelihood() -> None:
    logs = [of_unequal_lengths(), make_log()]
    made = small(logs)
    spreads = np.array([[-0.5, 0.1, 0.3], [0.0, -1.0, 0.7]])
    made._head.log_std.data = torch.from_numpy(spreads).float()[:, None]
    rows = made._streams.at(0)["row"].clone()
    observations = floats(made._data.observations(rows))
    expected, errors = [], []
    for lane, log in enumerate(logs):
        returns, densities = windows_of(log), []
        for i, row in enumerate(rows[lane].tolist()):
            wanted = standardised(log, returns[row])
            mean = network(made._actor, lane, np.append(observations[lane, i], wanted)[None])[0]
            difference = log.actions[row] - mean
            errors += (difference**2).tolist()
            density = 0.0
            for d, spread in zip(difference, spreads[lane], strict=True):
                std = math.exp(spread)
                density += -0.5 * (d / std) ** 2 - math.log(std * math.sqrt(2.0 * math.pi))
            densities.append(density)
        expected.append(-np.mean(densities))
    metrics = made.update(0)
    assert metrics["actor/loss"].tolist() == pytest.approx(expected, rel=1e-4)  # float32
    assert metrics["actor/imitation_error"].mean().item() == pytest.approx(
        np.mean(errors), rel=1e-4
    )


def test_dial_asks_for_the_mean_and_the_best_of_the_log() -> None:
    logs = [of_unequal_lengths(), make_log()]
    made = small(logs)
    run(made, 20)
    policy = made.policy(policy_card(logs[0], takes_proximity=True))
    assert policy.card.kind == "clipped"
    index = torch.tensor([[0, 30, 56]] * 2)
    seen, histories = made._data.observations(index), made._data.raw_histories(index)
    for proximity in (0.0, 0.25, 1.0):
        found = policy.act(histories, torch.full((2, 3), proximity))
        for lane, log in enumerate(logs):
            returns = list(windows_of(log).values())
            mean, best = np.mean(returns), max(returns)
            wanted = standardised(log, (1.0 - proximity) * mean + proximity * best)
            for i in range(3):
                inputs = np.append(floats(seen)[lane, i], wanted)
                expected = np.clip(network(made._actor, lane, inputs[None])[0], -1.0, 1.0)
                # frames are scaled twice in float32
                assert found[lane, i].tolist() == pytest.approx(expected, abs=1e-4)


def test_deployed_actions_are_clipped_to_the_box() -> None:
    made = small([make_log()])
    with torch.no_grad():
        last = made._actor.layers[-1]
        last.weight.zero_()
        last.bias.copy_(torch.tensor([[[3.0, -1.5, 0.25]]]))
    policy = made.policy(policy_card(takes_proximity=True))
    actions = policy.act(torch.full((1, 2, 3, 6), 50.0), torch.tensor([[0.0, 1.0]]))
    assert actions.tolist() == [[[1.0, -1.0, 0.25]] * 2]


def test_a_log_without_a_whole_window_is_refused_in_one_sentence() -> None:
    with pytest.raises(ValueError, match=r"^No trajectory of toy has window=41 steps; lower "):
        small([make_log(steps=40)], window=41)
    assert small([make_log(steps=40)], window=40)._returns.shape == (1, 240)


def test_equal_returns_everywhere_leave_finite_actions() -> None:
    log = make_log()
    log = relabelled(log, rewards=np.ones(log.transitions, dtype=np.float32))
    made = small([log])
    for metrics in run(made, 50):
        assert metrics["actor/loss"].isfinite().all()
    policy = made.policy(policy_card(log, takes_proximity=True))
    actions = policy.act(torch.full((1, 2, 3, 6), 50.0), torch.tensor([[0.0, 1.0]]))
    assert actions.isfinite().all()
    assert policy.finite.all()  # the scaling of lambda too
    # there is nothing to choose
    assert actions[0, 0].tolist() == pytest.approx(actions[0, 1].tolist(), abs=1e-5)


def test_asked_for_more_it_does_what_brought_more() -> None:
    # One step decides: the reward is the action's first entry, which was uniform.
    log = make_log(episodes=20, explore=1.0)
    log = relabelled(log, rewards=log.actions[:, 0].copy())
    made = small([log], window=1, hidden=(32,), batch=64, learning_rate=3e-3)
    run(made, 600)
    policy = made.policy(policy_card(log, takes_proximity=True))
    histories = made._data.raw_histories(torch.arange(200)[None])
    lazy, eager = (
        policy.act(histories, torch.full((1, 200), proximity))[0] for proximity in (0.0, 1.0)
    )
    # measured -0.016, 0.980 and 0.05 to 0.2 in the other entries
    assert lazy[:, 0].mean().item() == pytest.approx(log.actions[:, 0].mean(), abs=0.1)
    assert eager[:, 0].mean().item() == pytest.approx(1.0, abs=0.1)
    assert eager[:, 1:].abs().mean() < 0.3
    # the first entry is known from the return, the others are not: deviations 0 (from 1, still
    # falling: 0.16) and 0.58
    stds = made._head.log_std.exp()[0, 0]
    assert stds[0] < 0.25
    assert stds[1:].tolist() == pytest.approx([1.0 / math.sqrt(3.0)] * 2, abs=0.1)


def test_settings_outside_their_range_are_named() -> None:
    with pytest.raises(ValueError, match="window and hidden must be at least 1"):
        config("rvs", window=0)
    with pytest.raises(ValueError, match="discount lie in"):
        config("rvs", discount=1.1)
