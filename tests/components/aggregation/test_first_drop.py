"""The strategy of thesis 6.6.1 on curves that can be followed by hand."""

import math

import pytest

from components.aggregation.first_drop import Search, stop_at_first_drop


@pytest.mark.parametrize(
    ("returns", "ended"),
    [
        # the drop after the second point hides the best of all
        ([-5.0, -4.0, -4.5, -1.0], Search(chosen=1, tried=3, worst=-5.0)),
        # a curve that rises is followed to its end
        ([-5.0, -4.0, -3.0], Search(chosen=2, tried=3, worst=-5.0)),
        # the first step is a drop: the user stays at the start, having seen the worst
        ([-5.0, -9.0, -1.0], Search(chosen=0, tried=2, worst=-9.0)),
        # what changes nothing is no drop, and no reason to move
        ([-5.0, -5.0, -4.0, -4.0], Search(chosen=2, tried=4, worst=-5.0)),
        # a policy that breaks is one
        ([-5.0, -4.0, math.nan, -1.0], Search(chosen=1, tried=3, worst=-5.0)),
        ([-5.0], Search(chosen=0, tried=1, worst=-5.0)),
    ],
)
def test_it_ends_as_by_hand(returns: list[float], ended: Search) -> None:
    assert stop_at_first_drop(returns) == ended


@pytest.mark.parametrize("returns", [[], [math.nan, 1.0]])
def test_it_needs_a_start(returns: list[float]) -> None:
    with pytest.raises(ValueError, match="a start whose return is known"):
        stop_at_first_drop(returns)
