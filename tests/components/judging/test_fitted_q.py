"""Fitted Q evaluation on logs whose values are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import components.judging.fitted_q as module
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.judging.config import JudgeConfig
from components.judging.fitted_q import FittedQ, policy_values
from tests.components.interruption import killed_at, save_always
from tests.components.synthetic import CPU, make_log, relabelled

QUICK = JudgeConfig(hidden=(16,), batch=64, learning_rate=3e-3, target_rate=0.05, updates=600)
LOG = make_log(explore=1.0, discount=0.9, episodes=25)
POLICIES = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])


def evaluated(
    log: OfflineDataset,
    actions: Tensor = POLICIES,
    config: JudgeConfig = QUICK,
    checkpoint: Path | None = None,
) -> Tensor:
    """Values ``[R, Q]`` of policies that always act alike, ``actions [Q, A]``."""
    data = LaneData([log] * config.replicas, CPU)
    rows = torch.arange(log.transitions)
    starts = data.observations(torch.arange(4).expand(config.replicas, -1))
    found = policy_values(
        data,
        rows,
        actions[:, None].expand(-1, log.transitions, -1),
        (starts, actions[:, None].expand(-1, 4, -1)),
        config,
        key=1,
        names=[str(n) for n in range(len(actions))],
        checkpoint=checkpoint,
    )
    return found.mean(dim=2)


def rewarding(actions: np.ndarray) -> OfflineDataset:
    """The log, in which a step earns what the first action is."""
    return relabelled(LOG, rewards=np.ascontiguousarray(actions[:, 0]))


def horizon_sum(log: OfflineDataset) -> float:
    """What a reward of 1 at every step comes to."""
    card = log.card
    return (1 - card.discount**card.return_steps) / (1 - card.discount)


def test_a_constant_reward_gives_its_discounted_sum() -> None:
    log = relabelled(LOG, rewards=np.full(LOG.transitions, -2.0, np.float32))
    # Rewards without their mean are zero, and so are their critics, but for the initial weights,
    # whose trace the last batches decide: some hundredths of the deviation, which is 1 here.
    assert evaluated(log).numpy() == pytest.approx(-2 * horizon_sum(log), abs=0.1)


@pytest.mark.parametrize("ends", [False, True])
def test_without_a_discount_values_are_finite(ends: bool) -> None:
    rewards = np.abs(LOG.actions[:, 0])  # none below 0: that times infinity would be undefined
    terminated = LOG.truncated if ends else LOG.terminated
    log = relabelled(
        LOG, rewards=rewards, terminated=terminated, truncated=LOG.truncated & ~terminated
    )
    log = replace(log, card=replace(log.card, discount=1.0))
    config = JudgeConfig(hidden=(8,), batch=16, updates=20)
    assert evaluated(log, config=config).isfinite().all()


def test_policies_are_told_apart_by_what_their_actions_earn() -> None:
    log = rewarding(LOG.actions)
    # 600 updates leave a few per cent of error; the policies are 2 * 0.5 * 9.85 apart.
    expected = torch.tensor([-0.5, 0.5]) * horizon_sum(log)
    assert torch.allclose(evaluated(log).mean(dim=0), expected, atol=0.6)


def test_nothing_is_earned_after_a_terminal_state() -> None:
    ends = np.ones(LOG.transitions, np.bool_)
    log = relabelled(rewarding(LOG.actions), terminated=ends, truncated=~ends)
    found = evaluated(log).mean(dim=0)
    # Every transition ends: the value is the action's own reward, but for the fit of the critic.
    assert torch.allclose(found, torch.tensor([-0.5, 0.5]), atol=0.05)


def test_a_policy_gets_the_same_value_beside_others() -> None:
    log = rewarding(LOG.actions)
    config = JudgeConfig(hidden=(16,), batch=32, updates=100)
    both, alone = evaluated(log, POLICIES, config), evaluated(log, POLICIES[1:], config)
    # Products of other sizes are rounded otherwise, and Adam spreads that over 100 updates.
    assert torch.allclose(both[:, 1:], alone, rtol=1e-3, atol=1e-3)


def test_an_interrupted_evaluation_gives_the_same_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, config = rewarding(LOG.actions), JudgeConfig(hidden=(8,), batch=16, updates=60)
    whole = evaluated(log, config=config)
    save_always(monkeypatch, module)
    path = tmp_path / "critics.safetensors"
    pieces = killed_at(
        [25, 41],
        FittedQ,
        lambda own: evaluated(log, config=config, checkpoint=own),
        path,
        monkeypatch,
    )
    assert torch.equal(whole, pieces)
