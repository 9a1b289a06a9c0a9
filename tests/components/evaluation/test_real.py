"""Evaluation in the real system, against direct simulation and by hand."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator, lane_key
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.systems import make_batch
from components.evaluation.protocol import EvaluationProtocol
from components.evaluation.real import PolicyReturns, evaluate_policies
from components.networks import StackedMLP
from components.policies.policy import PROXIMITY_SCALING, Policy
from tests.components.synthetic import CPU, constant_policy, policy_card

SMALL = EvaluationProtocol(trajectories=3, horizon=12, proximity_step=0.25)
DISCOUNT = 0.9
SETPOINT = {"setpoint": 70.0}


def stack(parts: Sequence[Policy]) -> Policy:
    return Policy.concatenate(parts[0].card, parts)


def adaptive_policy() -> Policy:
    """Acts with tanh of the standardised proximity in its first entry, whatever it sees."""
    weight = torch.zeros(1, 19, 3)
    weight[0, 18, 0] = 1.0
    scaling = Normaliser(torch.zeros(1, 6), torch.ones(1, 6))
    card = policy_card(takes_proximity=True)
    return Policy.of_networks(card, {"actor": [(weight, torch.zeros(1, 1, 3))]}, scaling)


def network_policy(key: int, snapshots: int = 2) -> Policy:
    generators = [lane_generator(lane_key(key, n)) for n in range(snapshots)]
    scaling = Normaliser(torch.full((snapshots, 6), 50.0), torch.full((snapshots, 6), 30.0))
    network = StackedMLP(generators, (18, 16, 3))
    return Policy.of_networks(policy_card(), {"actor": network.affine()}, scaling)


def evaluate(
    policies: Sequence[Policy],
    keys: Sequence[int],
    protocol: EvaluationProtocol = SMALL,
    discount: float = DISCOUNT,
    behaviours: Sequence[Policy] = (),
    **options: Any,
) -> list[PolicyReturns]:
    behaviours = behaviours or [constant_policy([0.0, 0.0, 0.0])] * len(policies)
    return evaluate_policies(
        policies,
        behaviours,
        INDUSTRIAL_BENCHMARK_ID,
        SETPOINT,
        protocol,
        discount,
        keys,
        CPU,
        **options,
    )


def simulate(actions: np.ndarray, key: int, horizon: int, discount: float) -> np.ndarray:
    """Discounted returns ``[N]`` of constant actions ``[N, 3]``, straight from the environment."""
    machine = make_batch(INDUSTRIAL_BENCHMARK_ID, len(actions), **SETPOINT)
    machine.reset(lane_generator(key))
    total = np.zeros(len(actions))
    for t in range(horizon):
        _, rewards = machine.step(actions)
        total += discount**t * rewards
    return total


def test_constant_policies_earn_what_a_direct_simulation_earns() -> None:
    choices = [[0.5, -0.25, 0.0], [-0.9, 0.9, 0.1]]
    [result] = evaluate([stack([constant_policy(c) for c in choices])], [7])
    assert result.returns.shape == (2, 1, 3)
    assert np.isnan(result.proximities).tolist() == [True]
    expected = simulate(np.repeat(choices, 3, axis=0), 7, 12, 0.9).reshape(2, 1, 3)
    # float32 atanh and tanh of the actions
    np.testing.assert_allclose(result.returns, expected, rtol=1e-5)
    assert len(np.unique(result.returns)) == 6, "every trajectory has its own noise"


def broken_policy() -> Policy:
    """Finite numbers, and actions that are undefined wherever the velocity is not 0."""
    hidden = torch.zeros(1, 18, 16)
    hidden[0, 1] = 3e38
    cancelled = torch.ones(1, 16, 3)
    cancelled[0, ::2] = -1.0
    layers = [(hidden, torch.zeros(1, 1, 16)), (cancelled, torch.full((1, 1, 3), 0.5))]
    scaling = Normaliser(torch.tensor([[0.0, 50.0, 0.0, 0.0, 0.0, 0.0]]), torch.full((1, 6), 1e-3))
    return Policy.of_networks(policy_card(), {"actor": layers}, scaling)


def test_undefined_actions_have_no_return_and_leave_neighbours_alone() -> None:
    broken, fine = broken_policy(), network_policy(1, snapshots=1)
    assert broken.finite.all()
    middle = torch.zeros(1, 1, 3, 6)
    middle[..., 1] = 50.0  # where every trajectory starts
    assert broken.act(middle).isfinite().all()
    middle[..., 1] = 51.0
    assert broken.act(middle).isnan().all()
    found = evaluate([broken, fine], [5, 6])
    [alone] = evaluate([fine], [6])
    assert np.isnan(found[0].returns).all()
    assert np.isnan(found[0].distances).all()
    np.testing.assert_array_equal(found[1].returns, alone.returns)


def test_horizon_and_discount() -> None:
    protocol = EvaluationProtocol(trajectories=2, horizon=5)
    [result] = evaluate([constant_policy([0.1, 0.2, 0.3])], [3], protocol, discount=1.0)
    expected = simulate(np.tile([0.1, 0.2, 0.3], (2, 1)), 3, 5, 1.0)
    np.testing.assert_allclose(result.returns[0, 0], expected, rtol=1e-5)


def test_proximity_reaches_the_policy() -> None:
    [result] = evaluate([adaptive_policy()], [5])
    grid = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_array_equal(result.proximities, grid)
    assert result.returns.shape == (1, 5, 3)
    first = np.tanh((grid - 0.5) / float(PROXIMITY_SCALING.scale))
    actions = np.stack([first, np.zeros(5), np.zeros(5)], axis=1)
    expected = simulate(np.repeat(actions, 3, axis=0), 5, 12, 0.9).reshape(1, 5, 3)
    np.testing.assert_allclose(result.returns, expected, rtol=1e-5)
    # The behaviour policy stands still: the distance is the first entry's size.
    np.testing.assert_allclose(result.distances, np.abs(first)[None], rtol=1e-5, atol=1e-7)


def test_distance_is_euclidean() -> None:
    policy, behaviour = constant_policy([0.5, 0.0, -0.5]), constant_policy([0.2, -0.4, -0.5])
    [result] = evaluate([policy], [1], behaviours=[behaviour])
    assert result.distances.shape == (1, 1)
    assert result.distances[0, 0] == pytest.approx(0.5, rel=1e-5)  # a 3-4-5 triangle


def test_each_stack_is_measured_against_its_own_behaviour_policy() -> None:
    still, moving = constant_policy([0.0, 0.0, 0.0]), constant_policy([0.3, 0.0, 0.0])
    results = evaluate([still, still], [1, 1], behaviours=[still, moving])
    distances = [float(r.distances[0, 0]) for r in results]
    assert distances == pytest.approx([0.0, 0.3], rel=1e-5)


def test_numbers_do_not_depend_on_what_is_evaluated_beside() -> None:
    policies, keys = [network_policy(key) for key in (1, 2, 3)], [11, 12, 13]
    together = evaluate(policies, keys)
    for policy, key, expected in zip(policies, keys, together, strict=True):
        [alone] = evaluate([policy], [key])
        # actions in float32 may sum in another order; the machine is smooth over twelve steps
        np.testing.assert_allclose(alone.returns, expected.returns, rtol=1e-4)
        np.testing.assert_allclose(alone.distances, expected.distances, rtol=1e-4)
    again = evaluate(policies, keys)
    for one, other in zip(together, again, strict=True):
        np.testing.assert_array_equal(one.returns, other.returns)
    [other_stream] = evaluate(policies[:1], [99])
    assert not np.array_equal(other_stream.returns, together[0].returns)


def test_a_policy_sees_its_own_history() -> None:
    # The action is the newest velocity's change over two frames, scaled: 0 at first.
    weight = torch.zeros(1, 18, 3)
    weight[0, 1, 0], weight[0, 13, 0] = 1.0, -1.0
    policy = Policy.of_networks(
        policy_card(),
        {"actor": [(weight, torch.full((1, 1, 3), 0.4))]},
        Normaliser(torch.zeros(1, 6), torch.full((1, 6), 10.0)),
    )
    [result] = evaluate([policy], [2])
    machine = make_batch(INDUSTRIAL_BENCHMARK_ID, 3, **SETPOINT)
    frames = [machine.reset(lane_generator(2))] * 3
    total = np.zeros(3)
    for t in range(12):
        actions = np.full((3, 3), np.tanh(0.4))
        actions[:, 0] = np.tanh(0.4 + (frames[0][:, 1] - frames[2][:, 1]) / 10.0)
        new, rewards = machine.step(actions)
        frames = [new, *frames[:2]]
        total += 0.9**t * rewards
    np.testing.assert_allclose(result.returns[0, 0], total, rtol=1e-4)  # float32 actions


def test_progress_counts_steps() -> None:
    told: list[float] = []
    evaluate([constant_policy([0.0, 0.0, 0.0])], [0], progress=told.append)
    assert len(told) == 12
    assert told[-1] == 1.0


@pytest.mark.parametrize("discount", [0.0, 1.01, float("nan")])
def test_discounts_out_of_range_are_refused(discount: float) -> None:
    with pytest.raises(ValueError, match=r"discount must lie in \(0, 1\]"):
        evaluate([constant_policy([0.0, 0.0, 0.0])], [0], discount=discount)


def test_policies_that_see_other_frames_are_refused() -> None:
    policy = constant_policy([0.0, 0.0, 0.0])
    other = dataclasses.replace(policy.card, features=("setpoint", "velocity", "heat"))
    with pytest.raises(ValueError, match=r"^toy logs .*'heat'\), but proximity/Industrial.* shows"):
        evaluate([dataclasses.replace(policy, card=other)], [1])


def candidate_policy(key: int) -> Policy:
    """Draws three candidates at every state; two snapshots."""
    generators = [[lane_generator(lane_key(key, role, n)) for n in (0, 1)] for role in "ac"]
    networks = {
        "actor": StackedMLP(generators[0], (18, 8, 6)).affine(),
        "critic": StackedMLP(generators[1], (21, 8, 1)).affine(),
    }
    card = policy_card(kind="gaussian_candidates", candidates=3, noise=3)
    scaling = Normaliser(torch.full((2, 6), 50.0), torch.full((2, 6), 30.0))
    return Policy.of_networks(card, networks, scaling)


def test_policies_that_draw_candidates_have_their_own_noise() -> None:
    one, two = candidate_policy(1), candidate_policy(2)
    together = evaluate([one, two], [5, 6])
    for policy, key, found in zip((one, two), (5, 6), together, strict=True):
        [alone] = evaluate([policy], [key])
        np.testing.assert_array_equal(alone.returns, found.returns)
    [other] = evaluate([one], [7])
    assert not np.isclose(other.returns, together[0].returns).any()


def test_candidates_are_drawn_from_a_stream_that_the_system_does_not_use() -> None:
    policy, key = candidate_policy(1), 5
    [result] = evaluate([policy], [key])
    machine = make_batch(INDUSTRIAL_BENCHMARK_ID, 6, **SETPOINT)
    frames = [machine.reset(lane_generator(key))] * 3
    drawn, total = lane_generator(lane_key(key, "candidates")), np.zeros(6)
    for t in range(12):
        noise = torch.from_numpy(drawn.standard_normal((2, 3, 3, 3), np.float32))
        seen = torch.from_numpy(np.stack(frames, axis=1)).float().view(2, 3, 3, 6)
        actions = policy.act(seen, noise=noise).view(6, 3).numpy()
        new, rewards = machine.step(actions.astype(np.float64))
        frames = [new, *frames[:2]]
        total += 0.9**t * rewards
    # float32 actions, as above
    np.testing.assert_allclose(result.returns, total.reshape(2, 1, 3), rtol=1e-4)
