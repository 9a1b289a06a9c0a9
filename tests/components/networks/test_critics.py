"""Ensembles of critics: each is a plain network of its own, however it is evaluated."""

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.random_streams import spawn_generators
from components.networks import Critics, StackedMLP, soft_clipped_maximum
from tests.components.algorithms.plain import floats, network
from tests.components.synthetic import keys

LANES, BATCH, TRIED, SEEN, ACTED = 3, 5, 4, 4, 2
# float32: sums of a dozen products of about 1 in another order
CLOSE = {"rtol": 1e-4, "atol": 1e-5}


def critics(*names: object, count: int = 2) -> Critics:
    return Critics(keys(*names), SEEN, ACTED, (7, 6), count)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def pair(x: Tensor, actions: Tensor) -> np.ndarray:
    return np.concatenate([floats(x), floats(actions)], axis=-1)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_values_are_those_of_plain_networks(count: int) -> None:
    made = critics(*range(LANES), count=count)
    x, actions = normal(LANES, BATCH, SEEN), normal(LANES, BATCH, ACTED, seed=1)
    values, first = made(x, actions), made.first(x, actions)
    assert values.shape == (LANES, count, BATCH)
    assert first.shape == (LANES, BATCH)
    for lane in range(LANES):
        rows = pair(x[lane], actions[lane])
        for k in range(count):
            expected = network(made.stack, count * lane + k, rows)[:, 0]
            np.testing.assert_allclose(floats(values)[lane, k], expected, **CLOSE)
            if k == 0:
                np.testing.assert_allclose(floats(first)[lane], expected, **CLOSE)


@pytest.mark.parametrize("count", [1, 2])
def test_values_of_many_actions_are_those_of_plain_networks(count: int) -> None:
    made = critics(*range(LANES), count=count)
    x, actions = normal(LANES, BATCH, SEEN), normal(LANES, BATCH, TRIED, ACTED, seed=1)
    values = made.over_actions(x, actions)
    assert values.shape == (LANES, count, BATCH, TRIED)
    for lane in range(LANES):
        for k in range(count):
            for n in range(TRIED):
                rows = pair(x[lane], actions[lane, :, n])
                expected = network(made.stack, count * lane + k, rows)[:, 0]
                np.testing.assert_allclose(floats(values)[lane, k, :, n], expected, **CLOSE)


def test_errors_are_mean_squares_of_each_critic() -> None:
    made = critics(*range(LANES))
    x, actions = normal(LANES, BATCH, SEEN), normal(LANES, BATCH, ACTED, seed=1)
    targets = normal(LANES, BATCH, seed=2)
    errors = made.errors(x, actions, targets)
    assert errors.shape == (LANES, 2)
    for lane in range(LANES):
        for k in range(2):
            values = network(made.stack, 2 * lane + k, pair(x[lane], actions[lane]))[:, 0]
            expected = sum(
                (v - t) ** 2 for v, t in zip(values, targets[lane].tolist(), strict=True)
            )
            # float32, as above
            assert errors[lane, k].item() == pytest.approx(expected / BATCH, rel=1e-4)


def test_the_first_critic_is_evaluated_without_the_others() -> None:
    made = critics(*range(LANES))
    x, actions = normal(LANES, BATCH, SEEN), normal(LANES, BATCH, ACTED, seed=1)
    made.first(x, actions).sum().backward()
    for parameter in made.parameters():
        assert parameter.grad[0::2].abs().amax(dim=(1, 2)).gt(0).all()
        assert not parameter.grad[1::2].any()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter[1::2] = torch.nan
    assert made.first(x, actions).isfinite().all()
    for weight, bias in made.first_network():
        assert len(weight) == len(bias) == LANES
        assert weight.isfinite().all()


def test_a_lane_feels_no_other() -> None:
    made = critics(*range(LANES))
    x, actions = normal(LANES, BATCH, TRIED, SEEN)[:, :, 0], normal(LANES, BATCH, TRIED, ACTED)
    targets = normal(LANES, BATCH, seed=2)
    before = made(x, actions[:, :, 0]), made.over_actions(x, actions)
    made.errors(x, actions[:, :, 0], targets)[1].sum().backward()
    for parameter in made.parameters():
        by_lane = parameter.grad.unflatten(0, (LANES, 2)).flatten(2).abs().amax(dim=2)
        assert by_lane[1].gt(0).all()
        assert not by_lane[[0, 2]].any()
    x[1], actions[1] = 100.0, -100.0
    with torch.no_grad():
        for parameter in made.parameters():
            parameter[2:4] = 50.0
    after = made(x, actions[:, :, 0]), made.over_actions(x, actions)
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old[[0, 2]], new[[0, 2]])
        assert not torch.equal(old[1], new[1])


def test_initial_weights_depend_on_the_lanes_key_and_the_critics_number_only() -> None:
    together = critics("a", "b", "c", count=3)
    alone = critics("b", count=2)
    for many, few in zip(together.parameters(), alone.parameters(), strict=True):
        assert torch.equal(many[3:5], few)  # lane b, critics 0 and 1
    weight, bias = together.stack.affine()[0]
    for drawn in (weight, bias):
        assert len({tuple(row.flatten().tolist()) for row in drawn}) == 9


@pytest.mark.parametrize("hidden", [(), (7,), (7, 6)])
def test_over_actions_is_the_forward_pass_on_every_pair_with_its_gradients(
    hidden: tuple[int, ...],
) -> None:
    made = StackedMLP(spawn_generators(keys(0, 1), "weights"), (SEEN + ACTED, *hidden, 3))
    x = normal(2, BATCH, SEEN).requires_grad_()
    actions = normal(2, BATCH, TRIED, ACTED, seed=1).requires_grad_()
    weighing = normal(2, BATCH, TRIED, 3, seed=2)
    leaves = [x, actions, *made.parameters()]
    tried = made.over_actions(x, actions)
    assert tried.shape == (2, BATCH, TRIED, 3)
    one_by_one = [made(torch.cat([x, actions[:, :, n]], dim=-1)) for n in range(TRIED)]
    pairs = torch.stack(one_by_one, dim=2)
    # float32: the first layer's products are summed in two parts
    torch.testing.assert_close(tried, pairs, **CLOSE)
    ours = torch.autograd.grad((tried * weighing).sum(), leaves)
    theirs = torch.autograd.grad((pairs * weighing).sum(), leaves)
    for gradient, expected in zip(ours, theirs, strict=True):
        assert expected.abs().max() > 0.1
        # gradients of weights are sums over 20 pairs
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-4)


def test_soft_clipped_maximum_mixes_action_by_action_and_then_takes_the_best() -> None:
    values = torch.tensor(
        [
            # two critics, two states, three actions
            [[[0.0, 4.0, 2.0], [1.0, -1.0, -3.0]], [[10.0, 4.0, 3.0], [-1.0, -1.0, 9.0]]],
            [[[-8.0, -4.0, -6.0], [0.0, 0.0, 0.0]], [[-8.0, -8.0, -2.0], [4.0, 8.0, 0.0]]],
        ]
    )
    # lane 0: 2.5, 4, 2.25 (critics' maxima first would give 5.5) and -0.5, -1, 0 (not 3);
    # lane 1: -8, -7, -5 (not -3.5) and 1, 2, 0
    assert soft_clipped_maximum(values, 0.75).tolist() == [[4.0, 0.0], [-5.0, 2.0]]
    assert soft_clipped_maximum(values, 1.0).tolist() == [[4.0, -1.0], [-6.0, 0.0]]
    assert soft_clipped_maximum(values, 0.0).tolist() == [[10.0, 9.0], [-2.0, 8.0]]


def test_soft_clipped_maximum_of_three_critics_ignores_the_middle_one() -> None:
    values = torch.tensor([[[[1.0]], [[100.0]], [[2.0]]]])
    assert soft_clipped_maximum(values, 0.5).tolist() == [[50.5]]
