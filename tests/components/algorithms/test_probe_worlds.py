"""Worlds whose answers are known: constant rewards; a bandit whose best action was not logged."""

from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import ALGORITHMS
from components.data.dataset import OfflineDataset
from tests.components.algorithms.stacks import graded, learner, run
from tests.components.synthetic import make_log, policy_card, relabelled

pytestmark = pytest.mark.slow(1)

# Large rates, since training is short.
QUICK: dict[str, dict[str, Any]] = {
    "bc": {},
    "rvs": {"window": 1},
    "ddpg": {},
    "td3_bc": {},
    "lambda_td3_bc": {},
    "bcq": {},
    "bear": {"actor_learning_rate": 3e-3, "multiplier_learning_rate": 0.03},
    "brac": {"actor_learning_rate": 3e-3, "cloning_learning_rate": 3e-3, "cloning": 0.6},
    "cql": {"actor_learning_rate": 3e-3},
}
CRITIC_BASED = ("ddpg", "bcq", "bear", "brac", "cql", "td3_bc")


def trained(name: str, log: OfflineDataset, updates: int, **changes: Any) -> Any:
    """A learner after a short training with large rates."""
    settings = QUICK[name] | {"learning_rate": 3e-3, "batch": 64, "updates": updates} | changes
    made = learner(name, [log], [0], **settings)
    run(made, updates + made.pretraining)
    return made


@pytest.mark.parametrize(("terminal", "value"), [(False, 1.0 / (1.0 - 0.6)), (True, 1.0)])
@pytest.mark.parametrize("name", graded(CRITIC_BASED, 3))
def test_value_of_a_constant_reward(name: str, terminal: bool, value: float) -> None:
    """Q = r / (1 - gamma) where nothing ends, r where every step does."""
    log = make_log()
    ones = np.ones(log.transitions, dtype=np.float32)
    log = relabelled(log, rewards=ones, terminated=np.full(log.transitions, terminal))
    # What BRAC and CQL take from values on purpose is switched off.
    without = {"brac": {"alpha": 0.0, "cloning": 0.01}, "cql": {"weight": 0.0}}.get(name, {})
    made = trained(name, log, 600, discount=0.6, target_rate=0.1, **without)
    batch = made._data.batch(torch.arange(0, log.transitions, 3)[None])
    critics = made._critic if name == "ddpg" else made._critics
    values = critics(batch.observations, batch.actions)
    # measured means 2.42 (BCQ) to 2.60 (DDPG) and 0.993 to 1.002; DDPG's actor seeks what the
    # critic overrates
    nearness = 0.03 if name == "td3_bc" else 0.06  # its means: 2.456 and 0.997
    assert values.mean().item() == pytest.approx(value, rel=nearness)
    # measured root mean squares at most 0.17 and 0.05 (BCQ)
    assert (values - value).square().mean().sqrt().item() < 0.1 * value


def bandit_actions(name: str, **changes: Any) -> torch.Tensor:
    """Deployed actions in one-step episodes whose reward grows up to the bound, 200 states.

    Logged are N(0, 0.1) in every entry: the best action 1 is ten deviations away.
    """
    log = make_log(episodes=20)
    actions = np.random.default_rng(0).normal(0.0, 0.1, log.actions.shape).astype(np.float32)
    assert np.abs(actions).max() < 0.45
    log = relabelled(
        log,
        actions=actions,
        rewards=-2.0 + 0.5 * actions.mean(axis=1),
        terminated=np.ones(log.transitions, dtype=np.bool_),
    )
    made = trained(name, log, 500, hidden=(32,), **changes)
    takes_proximity = ALGORITHMS[name].takes_proximity
    policy = made.policy(policy_card(log, takes_proximity=takes_proximity))
    histories = made._data.raw_histories(torch.arange(200)[None])
    shape = (1, 200, policy.card.candidates, policy.card.noise)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    chosen = policy.act(
        histories,
        torch.zeros(1, 200) if takes_proximity else None,
        noise if policy.card.candidates else None,
    )
    return chosen[0]


def test_unconstrained_values_lead_out_of_the_data() -> None:
    assert bandit_actions("ddpg").mean() > 0.8  # measured 0.96 to 1.00 with three seeds


# Root mean square distance from the logged mean 0 that deployed actions may have.
CLONES = [("bc", 0.1), ("rvs", 0.1), ("lambda_td3_bc", 0.1)]  # measured 0.02 to 0.05; lambda is 0
CONSTRAINED = [
    # perturbations of generated actions go up to 0.05; measured 0.050 to 0.057
    ("bcq", 0.1),
    ("bear", 0.1),  # measured 0.019 to 0.026
    # alpha / (2 sigma^2) of the squared distance against a slope of 0.17 per entry meet at 0.02;
    # measured 0.030 to 0.036
    ("brac", 0.1),
    ("cql", 0.1),  # measured 0.015 to 0.019
    # alpha Q / |Q| and the squared distance meet at 2.5 * 0.5 / (2 * 1.83) = 0.34;
    # measured 0.31 to 0.36
    ("td3_bc", 0.5),
]


@pytest.mark.slow(2)
@pytest.mark.parametrize(("name", "near"), CLONES + CONSTRAINED)
def test_the_others_stay_near_the_data(name: str, near: float) -> None:
    assert bandit_actions(name).square().mean().sqrt() < near


UNTIED: list[tuple[str, dict[str, Any], float]] = [
    ("bcq", {"perturbation": 1.0}, 0.8),  # measured 0.99
    ("bear", {"threshold": 10.0}, 0.8),  # 0.996
    ("brac", {"alpha": 0.0}, 0.8),  # 0.998
    ("cql", {"weight": 0.0}, 0.2),  # 0.31: its entropy term slows it down
    ("td3_bc", {"alpha": 1e4}, 0.8),  # 0.93
]


@pytest.mark.slow(2)
@pytest.mark.parametrize(("name", "changes", "away"), UNTIED)
def test_it_is_the_constraint_that_holds_them(
    name: str, changes: dict[str, Any], away: float
) -> None:
    assert bandit_actions(name, **changes).square().mean().sqrt() > away
