"""Sensors that fail, and what merely looks so: plants rest, saturate and are run by hand."""

from itertools import pairwise

import numpy as np
import pytest

from components.data.imports.faults import find_far, find_flat, find_linear

RNG = np.random.default_rng(0)


def sensor(rows: int = 5000, digits: int = 2) -> np.ndarray:
    """A noisy reading about 20, rounded."""
    return np.round(20 + np.random.default_rng(1).normal(0, 1, rows), digits).astype(np.float32)


def test_the_longest_flat_run_of_a_sensor_is_found_with_all_others() -> None:
    values = sensor()
    values[700:760], values[3000:4000] = 20.125, 20.375  # of more digits than all others
    found = find_flat(values)
    assert (found.first, found.length, found.count, found.rows) == (3000, 1000, 2, 1060)
    values[:4900] = 20.125  # nearly all the time
    assert find_flat(values).length == 4900


def held(rows: int, hold: int, ramp: int = 0) -> np.ndarray:
    """A set point that is changed now and then, in ramps of so many rows."""
    levels = np.random.default_rng(2).uniform(10, 30, rows // hold + 2)
    parts = [
        np.append(np.full(hold - ramp, one), np.linspace(one, other, ramp, endpoint=False))
        for one, other in pairwise(levels)
    ]
    return np.concatenate(parts)[:rows].astype(np.float32)


def saturated() -> np.ndarray:
    values = sensor()
    values[2000:2500] = values.max()
    return values


@pytest.mark.parametrize(
    "values",
    [
        sensor(),
        sensor(digits=0),  # seven values, so runs of some rows
        held(5000, 100),
        held(5000, 1500, ramp=20),
        held(5000, 200, ramp=20),
        saturated(),
        np.where(sensor() > 20, sensor(), 0).astype(np.float32),  # a flow that is often off
        (np.arange(5000) // 700).astype(np.float32),  # a counter
        np.sin(np.arange(5000) / 50).astype(np.float32),
    ],
)
def test_what_is_held_saturated_coarse_or_smooth_does_not_hang(values: np.ndarray) -> None:
    assert find_flat(values) is None


def test_far_values_are_counted_and_the_first_is_found() -> None:
    values = sensor()
    values[[40, 900, 901]] = -9999
    found = find_far(values)
    assert (found.first, found.count, found.low, found.high) == (40, 3, -9999, -9999)
    assert 18 < found.usual[0] < found.usual[1] < 22
    values[60] = 999  # on the other side, too
    assert (find_far(values).count, find_far(values).high) == (4, 999)
    ignored = values < 0
    assert find_far(values, ignored).first == 60
    assert find_far(values, ignored | (values == 999)) is None


def cooled() -> np.ndarray:
    """A furnace at 850, which cools down to 20 once."""
    values = 850 + sensor() - 20
    values[3000:3200] = 20 + 830 * np.exp(-np.arange(200) / 30)
    return values


@pytest.mark.parametrize(
    "values",
    [
        sensor(),
        cooled(),
        np.exp(2 * RNG.normal(size=100_000)).astype(np.float32),  # long tails
        (RNG.random(5000) < 0.01).astype(np.float32),  # a rare event
        np.where(RNG.random(5000) < 0.3, -50, sensor()).astype(np.float32),  # two regimes
    ],
)
def test_tails_events_and_regimes_are_not_far(values: np.ndarray) -> None:
    assert find_far(values) is None


def test_copies_in_another_unit_are_found_and_like_sensors_are_not() -> None:
    kelvin = sensor(digits=4) + 273.15
    twin = sensor(digits=4) + RNG.normal(0, 0.05, 5000)  # its own noise
    table = np.stack([sensor(digits=4), twin, kelvin, -2.0 * kelvin + 7], axis=1).astype(float)
    table[[7, 99]] = -9999  # all of them fail at once
    found = find_linear(table)
    assert [(copy, model) for copy, model, _, _ in found] == [(2, 0), (3, 0)]
    # single precision and four digits, of 0.01 % of the spread
    assert found[0][2:] == pytest.approx((1, 273.15), rel=1e-3)
    assert found[1][2:] == pytest.approx((-2, 7 - 2 * 273.15), rel=1e-3)
    table[:, 0] = 5
    assert [(copy, model) for copy, model, _, _ in find_linear(table)] == [(3, 2)]
