"""Checks of settings that several algorithms share."""

from dataclasses import dataclass

import pytest

from components.algorithms.parts.ranges import (
    check_at_least_one,
    check_bootstrapping,
    check_virtual_starts,
)


@dataclass
class Settings:
    updates: int = 1
    batch: int = 3
    hidden: tuple[int, ...] = (8, 1)


@pytest.mark.parametrize("wrong", [{"updates": 0}, {"batch": -1}, {"hidden": (8, 0)}])
def test_counts_below_one_are_refused_with_all_their_names(wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"^updates, batch and hidden must be at least 1\.$"):
        check_at_least_one(Settings(**wrong), "updates", "batch", "hidden")


def test_no_layers_are_no_count_below_one() -> None:
    check_at_least_one(Settings(), "updates", "batch", "hidden")
    check_at_least_one(Settings(hidden=()), "hidden")
    with pytest.raises(ValueError, match=r"^batch must be at least 1\.$"):
        check_at_least_one(Settings(batch=0), "batch")


@pytest.mark.parametrize(("discount", "rate"), [(0.0, 0.5), (1.0, 0.5), (0.9, 0.0), (0.9, 1.1)])
def test_bootstrapping_needs_a_horizon_and_targets_that_move(discount: float, rate: float) -> None:
    check_bootstrapping(0.99, 1.0)
    with pytest.raises(ValueError, match=r"discount must lie in \(0, 1\) and target_rate"):
        check_bootstrapping(discount, rate)


@pytest.mark.parametrize(
    ("discount", "window", "after", "field"),
    [(0.0, 5, 0, "discount"), (1.1, 5, 0, "discount"), (1.0, 5, 5, "after"), (1.0, 5, -1, "after")],
)
def test_virtual_starts_need_a_step(discount: float, window: int, after: int, field: str) -> None:
    check_virtual_starts(1.0, 5, 4)
    with pytest.raises(ValueError, match=field):
        check_virtual_starts(discount, window, after)
