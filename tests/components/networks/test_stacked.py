"""Stacks of networks: every lane is a plain network of its own."""

from collections.abc import Sequence

import pytest
import torch
from torch import nn

from components.core.random_streams import lane_generator, lane_key, spawn_generators
from components.networks import (
    StackedLinear,
    StackedMLP,
    lane_groups,
    lanewise_mean,
    polyak_update,
    select_lanes,
)
from tests.components.synthetic import keys

SIZES = (5, 7, 6, 2)


def stack(*names: object, activation: object = torch.relu) -> StackedMLP:
    return StackedMLP(spawn_generators(keys(*names), "weights"), SIZES, activation)


def plain(network: StackedMLP, lane: int, activation: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """The lane as an ordinary torch network."""
    modules: list[nn.Module] = []
    for weight, bias in network.affine():
        linear = nn.Linear(weight.shape[1], weight.shape[2])
        with torch.no_grad():
            linear.weight.copy_(weight[lane].T)
            linear.bias.copy_(bias[lane, 0])
        modules += [linear, activation()]
    return nn.Sequential(*modules[:-1])


@pytest.mark.parametrize("activation", [(torch.relu, nn.ReLU), (torch.tanh, nn.Tanh)])
def test_a_lane_computes_what_a_plain_network_computes(activation: tuple) -> None:
    network = stack(0, 1, 2, activation=activation[0])
    x = torch.randn(3, 11, 5, generator=torch.Generator().manual_seed(0))
    out = network(x)
    assert out.shape == (3, 11, 2)
    for lane in range(3):
        # float32: sums of seven products in another order
        torch.testing.assert_close(out[lane], plain(network, lane, activation[1])(x[lane]))


def test_gradients_of_a_lane_are_those_of_the_plain_network() -> None:
    network = stack(0, 1)
    x = torch.randn(2, 9, 5, generator=torch.Generator().manual_seed(1))
    lanewise_mean(network(x).square()).sum().backward()
    for lane in range(2):
        alone = plain(network, lane)
        alone(x[lane]).square().mean().backward()
        for (weight, bias), linear in zip(network.affine(), alone[::2], strict=True):
            torch.testing.assert_close(weight.grad[lane], linear.weight.grad.T)
            torch.testing.assert_close(bias.grad[lane, 0], linear.bias.grad)


def test_initial_weights_depend_on_the_own_key_only() -> None:
    together = stack("a", "b", "c")
    assert together.lanes == 3
    for lane, name in enumerate("abc"):
        for ours, alone in zip(together.parameters(), stack(name).parameters(), strict=True):
            assert torch.equal(ours[lane], alone[0])
    weight = together.affine()[0][0]
    assert not torch.equal(weight[0], weight[1])


def test_initial_weights_fill_the_range_of_the_fan_in() -> None:
    layer = StackedLinear(spawn_generators([lane_key("wide")], "weights"), 100, 200)
    for drawn in (layer.weight, layer.bias):
        assert drawn.abs().max() <= 0.1
        # at least 200 uniform draws in +-0.1: chance of a maximum below 0.09 is 0.9^200 = 7e-10
        assert drawn.max() > 0.09
        assert drawn.min() < -0.09


def test_polyak_update_by_hand() -> None:
    target, online = stack(0), stack(1)
    before = [p.detach().clone() for p in target.parameters()]
    polyak_update([(target, online)], 0.25)
    for old, new, p in zip(before, online.parameters(), target.parameters(), strict=True):
        torch.testing.assert_close(p, 0.25 * new + 0.75 * old)
    polyak_update([(target, online)], 1.0)
    for new, p in zip(online.parameters(), target.parameters(), strict=True):
        torch.testing.assert_close(p, new)


def test_lanewise_mean() -> None:
    x = torch.arange(12.0).view(2, 3, 2)
    assert lanewise_mean(x).tolist() == [2.5, 8.5]


@pytest.mark.parametrize("lanes", [[0], [2, 0], [1, 1], []])
def test_select_lanes_with_twins(lanes: Sequence[int]) -> None:
    state = {"single": torch.arange(3), "twin": torch.arange(12).view(6, 2)}
    picked = select_lanes(state, lanes, of=3)
    assert picked["single"].tolist() == list(lanes)
    rows = [[4 * n, 4 * n + 1, 4 * n + 2, 4 * n + 3] for n in lanes]
    assert picked["twin"].flatten().tolist() == [v for row in rows for v in row]


@pytest.mark.parametrize("tensor", [torch.zeros(4, 2), torch.tensor(1.0)])
def test_select_lanes_names_what_holds_no_lanes(tensor: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"odd has shape .* holds no 3 lanes"):
        select_lanes({"odd": tensor}, [0], of=3)


def test_parts_of_a_stack_share_its_memory() -> None:
    stack = StackedMLP([lane_generator(key) for key in range(6)], (3, 4, 1))  # three lanes of two
    parts = lane_groups(stack, 3, 2)
    assert [lanes for lanes, _ in parts] == [slice(0, 2), slice(2, 3)]
    with torch.no_grad():
        for parameter in stack.parameters():
            parameter.mul_(2.0)
    x = torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(0))
    together = torch.cat([parts[0][1](x[:4]), parts[1][1](x[4:])])
    # products over four and two lanes may sum in another order than over six
    torch.testing.assert_close(together, stack(x))
    with torch.no_grad():
        parts[1][1].affine()[0][0].zero_()
    assert (stack.affine()[0][0][4:] == 0.0).all()
    assert (stack.affine()[0][0][:4] != 0.0).all()


@pytest.mark.parametrize(("lanes", "groups"), [(3, 1), (1, 2)])
def test_a_single_part_is_the_stack_itself(lanes: int, groups: int) -> None:
    stack = StackedMLP([lane_generator(key) for key in range(2 * lanes)], (3, 4, 1))
    [(covered, part)] = lane_groups(stack, lanes, groups)
    assert covered == slice(0, lanes)
    assert part is stack
