"""A learning rate changes where it lies."""

import pytest
import torch

from components.training.loop import adam
from components.training.schedule import Schedule


def scheduled(rate: torch.Tensor) -> Schedule:
    weights = [torch.zeros(2, requires_grad=True)]
    return Schedule(torch.optim.Adam(weights, lr=rate, fused=True), lambda step: 0.1 * step)


def test_a_rate_that_is_a_number_is_replaced() -> None:
    plain = adam([torch.zeros(2, requires_grad=True)], 0.1)
    schedule = Schedule(plain, lambda step: 0.1 * step)
    schedule.stage(4, 3)  # changes nothing
    schedule.follow(2)
    assert plain.param_groups[0]["lr"] == 0.2


def test_a_rate_in_memory_is_written_there() -> None:
    rate = torch.tensor(0.1)
    schedule = scheduled(rate)
    schedule.follow(2)
    assert rate.item() == pytest.approx(0.2)
    schedule.stage(4, 3)
    assert rate.item() == pytest.approx(0.2), "staged, not set"
    schedule.follow(5)
    assert rate.item() == pytest.approx(0.5)
    schedule.follow(9)
    assert rate.item() == pytest.approx(0.9), "not staged, and right none the less"


def test_runs_of_one_length_are_staged_in_one_place() -> None:
    schedule = scheduled(torch.tensor(0.1))
    schedule.stage(4, 3)
    place = schedule._staged[3]
    schedule.stage(7, 1)
    schedule.stage(10, 3)
    assert schedule._staged[3] is place
    assert place.tolist() == pytest.approx([1.0, 1.1, 1.2])
