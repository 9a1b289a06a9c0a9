"""The state of learners as flat tensors, the way there and back."""

import torch

from components.training.loop import adam
from components.training.state import (
    load_optimizer_state,
    optimizer_state,
    prefixed,
    with_prefix,
)


def test_prefixes() -> None:
    state = prefixed("a", {"x": torch.zeros(1)}) | prefixed("ab", {"y": torch.ones(1)})
    assert with_prefix("a", state).keys() == {"x"}
    assert with_prefix("ab", state).keys() == {"y"}


def test_optimizer_state_has_lanes_and_continues_exactly() -> None:
    def step(parameter: torch.Tensor, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        (parameter - torch.arange(6.0).view(2, 3)).square().sum().backward()
        optimizer.step()

    parameter = torch.zeros(2, 3, requires_grad=True)
    optimizer = adam([parameter], 0.1)
    assert optimizer_state(optimizer) == {}
    for _ in range(3):
        step(parameter, optimizer)
    state = optimizer_state(optimizer)
    assert {tensor.shape[0] for tensor in state.values()} == {2}
    assert state["0.step"].tolist() == [3.0, 3.0]
    copy = parameter.detach().clone().requires_grad_()
    other = adam([copy], 0.1)
    load_optimizer_state(other, {name: tensor.clone() for name, tensor in state.items()})
    for _ in range(3):
        step(parameter, optimizer)
        step(copy, other)
    assert torch.equal(parameter, copy)
