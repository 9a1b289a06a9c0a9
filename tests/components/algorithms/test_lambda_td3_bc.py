"""lambda-TD3+BC: equation 6.9 by hand, and both ends of the dial."""

import dataclasses

import numpy as np
import pytest
import torch

from components.algorithms import lambda_td3_bc
from components.data.batches import Batch
from tests.components.algorithms.plain import critic, floats, network
from tests.components.algorithms.stacks import config, learner, run, scattered
from tests.components.synthetic import make_log, policy_card, relabelled

STEPS = 40


def small(lanes: int = 2, **changes: object) -> lambda_td3_bc.Learner:
    """Learners whose targets are other networks than the online ones."""
    log = make_log()
    terminated = np.zeros(log.transitions, dtype=np.bool_)
    terminated[2 * STEPS - 1] = True  # the second episode ends in a terminal, the others in time
    log = relabelled(log, terminated=terminated)
    made = learner("lambda_td3_bc", [log] * lanes, list(range(lanes)), **changes)
    return scattered(made, 0.3, "actor_target", "critics_target")


def batch_at(made: lambda_td3_bc.Learner, rows: list[int], proximity: list[float]) -> Batch:
    """The learner's batch of these transitions with these lambdas."""
    drawn = {"row": rows, "proximity": proximity}
    return made._batch(
        {name: torch.tensor([values] * made.lanes) for name, values in drawn.items()}
    )


def plain_observation(made: lambda_td3_bc.Learner, row: int, proximity: float) -> np.ndarray:
    """A logged observation and lambda, scaled with the moments of a uniform number."""
    seen = made._data.observations(torch.tensor([[row]] * made.lanes))
    return np.append(floats(seen)[0, 0], (proximity - 0.5) / 0.2887)


def test_actor_loss_is_equation_6_9() -> None:
    made = small(alpha=2.5)
    rows, dial = [0, 5, 40, 77, 100], [0.0, 1.0, 0.3, 0.9, 0.02]
    loss, metrics = made._actor_loss(batch_at(made, rows, dial))
    for lane in range(2):
        values, distances = [], []
        for row, proximity in zip(rows, dial, strict=True):
            seen = plain_observation(made, row, proximity)
            chosen = np.tanh(network(made._actor, lane, seen[None])[0])
            values.append(critic(made._critics.stack, 2 * lane, seen, chosen))
            distances.append(np.mean((chosen - made._data.datasets[0].actions[row]) ** 2))
        magnitude = np.mean(np.abs(values))
        terms = [
            -proximity * 2.5 / magnitude * value + (1.0 - proximity) * distance
            for proximity, value, distance in zip(dial, values, distances, strict=True)
        ]
        # float32
        assert loss[lane].item() == pytest.approx(np.mean(terms), rel=1e-4, abs=1e-6)
        assert metrics["actor/imitation_error"][lane].item() == pytest.approx(
            np.mean(distances), rel=1e-5
        )


def test_targets_use_the_same_lambda_after_the_step() -> None:
    made = small()
    rows, dial = [3, STEPS - 1, 2 * STEPS - 1], [0.1, 0.95, 0.4]
    batch = batch_at(made, rows, dial)
    noise = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(1)) * 2.0
    targets = made._targets(batch, noise)
    plain_next = made._data.batch(torch.tensor([rows] * 2)).next_observations
    for lane in range(2):
        expected = []
        for i, (row, proximity) in enumerate(zip(rows, dial, strict=True)):
            after = np.append(floats(plain_next)[lane, i], (proximity - 0.5) / 0.2887)
            smoothing = np.clip(0.2 * floats(noise)[lane, i], -0.5, 0.5)
            chosen = np.tanh(network(made._actor_target, lane, after[None])[0]) + smoothing
            chosen = np.clip(chosen, -1.0, 1.0)
            stack = made._critics_target.stack
            least = min(critic(stack, 2 * lane + j, after, chosen) for j in range(2))
            alive = row != 2 * STEPS - 1
            expected.append(made._data.datasets[0].rewards[row] + 0.97 * alive * least)
        assert targets[lane].tolist() == pytest.approx(expected, rel=1e-4)  # float32


def test_every_transition_draws_its_own_lambda_from_the_beta_distribution() -> None:
    made = learner("lambda_td3_bc", [make_log()], [0], batch=256)
    drawn = torch.cat([made._streams.at(step)["proximity"] for step in range(50)])
    assert drawn.shape == (50, 256)
    assert drawn.min() >= 0.0
    assert drawn.max() <= 1.0
    # Beta(0.1, 0.1): mean 1/2, variance 1 / (4 * 1.2); 12,800 numbers: 4 and 6 standard errors
    assert drawn.mean().item() == pytest.approx(0.5, abs=0.016)
    assert drawn.var().item() == pytest.approx(1 / 4.8, abs=0.006)
    assert drawn[0].unique().numel() > 100
    # the update gives both states the one that was drawn, in another place than the frames
    first = {name: value.clone() for name, value in made._streams.at(0).items()}
    batch = made._batch(first)
    expected = (first["proximity"] - 0.5) / 0.2887
    for observations in (batch.observations, batch.next_observations):
        assert observations.shape[-1] == made._data.observation_width + 1
        torch.testing.assert_close(observations[..., -1], expected)


def test_at_zero_values_do_not_count_and_at_one_the_log_does_not() -> None:
    made, other = small(lanes=1), small(lanes=1)
    with torch.no_grad():
        for parameter in other._critics.parameters():
            parameter.mul_(-0.5)

    def slope(one: lambda_td3_bc.Learner, proximity: float, sign: float) -> torch.Tensor:
        batch = batch_at(one, [0, 5, 40, 77, 100], [proximity] * 5)
        loss, _ = one._actor_loss(dataclasses.replace(batch, actions=sign * batch.actions))
        (gradient,) = torch.autograd.grad(loss.sum(), [one._actor.layers[-1].bias])
        return gradient

    for proximity in (0.0, 0.5, 1.0):
        usual = slope(made, proximity, 1.0)
        assert usual.abs().max() > 0.01
        # lambda passes through the network's input and back: float32 leaves 1e-7 of it
        values_count = not torch.allclose(usual, slope(other, proximity, 1.0), atol=1e-6)
        log_counts = not torch.allclose(usual, slope(made, proximity, -1.0), atol=1e-6)
        assert values_count == (proximity > 0.0)
        assert log_counts == (proximity < 1.0)


@pytest.mark.slow(2)
def test_proximity_goes_from_imitation_to_the_greatest_value() -> None:
    # The reward is the action's first entry, logged actions are tanh N(-0.5, 0.3) there.
    log = make_log(episodes=20)
    actions = np.tanh(np.random.default_rng(0).normal(-0.5, 0.3, log.actions.shape))
    actions = actions.astype(np.float32)
    log = relabelled(
        log,
        actions=actions,
        rewards=actions[:, 0].copy(),
        terminated=np.ones(log.transitions, dtype=np.bool_),
    )
    made = learner("lambda_td3_bc", [log], [0], learning_rate=3e-3, batch=64, hidden=(32,))
    run(made, 1000)
    policy = made.policy(policy_card(log, takes_proximity=True))
    histories = made._data.raw_histories(torch.arange(200)[None])
    means = [
        policy.act(histories, torch.full((1, 200), proximity))[0].mean(dim=0)
        for proximity in (0.0, 1.0)
    ]
    # at 0 the log's mean, about -0.44 in every entry; measured within 0.025
    assert means[0].tolist() == pytest.approx(actions.mean(axis=0).tolist(), abs=0.1)
    # at 1 the bound, which was never logged; measured 1.000
    assert actions[:, 0].max() < 0.7
    assert means[1][0] > 0.9


def test_settings_outside_their_range_are_named() -> None:
    with pytest.raises(ValueError, match="beta must be positive"):
        config("lambda_td3_bc", beta=0.0)
    with pytest.raises(ValueError, match="batch"):
        config("lambda_td3_bc", batch=0)
