"""Shapes of curves over a trade-off, in closed form."""

import math

import pytest

from components.evaluation.curves import Shape, first_drop, shape_of


@pytest.mark.parametrize(
    ("curve", "found"),
    [
        ([-3.0, -2.0, -1.0], (2, 3)),  # it never drops
        ([-3.0, -1.0, -2.0, 0.0], (1, 3)),  # the better one beyond the drop is not seen
        ([-1.0, -2.0], (0, 2)),
        ([-2.0, -2.0, -1.0, -1.0], (2, 4)),  # a plateau is no drop
        ([-5.0], (0, 1)),
    ],
)
def test_the_search_stops_at_the_first_drop(curve: list[float], found: tuple[int, int]) -> None:
    assert first_drop(curve) == found


def test_shape_of_a_hump_and_of_a_zigzag() -> None:
    assert shape_of([0.0, 4.0, 2.0]) == Shape(peak=4.0, at=1, area=2.5, greatest_fall=2.0, zigzag=0)
    # Up 4, down 3, up 1: two of its eight units lie beyond a rise to 4 and a fall to 2.
    assert shape_of([0.0, 4.0, 1.0, 2.0]).zigzag == 2.0
    assert shape_of([7.0]) == Shape(7.0, 0, 7.0, 0.0, 0.0)


def test_area_knows_where_settings_lie() -> None:
    # Penalties from the largest down: three quarters of the way at 1, the rest up to 3.
    assert shape_of([1.0, 1.0, 3.0], [2.0, 0.5, 0.0]).area == pytest.approx(1.25, abs=1e-12)


def test_what_is_no_curve_is_refused() -> None:
    for wrong in ([], [1.0, math.nan]):
        with pytest.raises(ValueError, match="at least one return"):
            first_drop(wrong)
    with pytest.raises(ValueError, match="rising or in falling order"):
        shape_of([1.0, 2.0, 3.0], [0.0, 0.5, 0.5])
