"""Pools of policies by hand."""

import dataclasses
import math

import numpy as np
import pytest

from components.aggregation.statistics import pool_policies, summarise


def test_a_pool_of_ten_by_hand() -> None:
    pool = np.array([-70.0, -90.0, -80.0, -60.0, -75.0, -65.0, -85.0, -95.0, -55.0, -100.0])
    found = summarise(pool)
    assert found.policies == 10
    # sorted -100, -95, ...: position 0.1 * 9 = 0.9 between the two lowest
    assert found.tenth_percentile == pytest.approx(-100.0 + 0.9 * 5.0)
    assert found.mean == pytest.approx(-77.5)
    # deviations +-2.5, 7.5, 12.5, 17.5, 22.5: squares sum to 2 * 1031.25
    assert found.std == pytest.approx(math.sqrt(2062.5 / 9))
    assert found.standard_error == pytest.approx(1.7 * math.sqrt(2062.5 / 9 / 10))
    # two cut from either end: -90 ... -65
    assert found.iqm == pytest.approx(np.mean([-90, -85, -80, -75, -70, -65]))


@pytest.mark.parametrize(
    ("pool", "iqm"),
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 9.0], 4.0),
        ([100.0, 1.0, 2.0, -50.0], 1.5),
        ([100.0, 1.0, 2.0, 3.0, -50.0, 4.0, 5.0], 3.0),
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 60.0, 70.0], 3.5),
    ],
)
def test_interquartile_mean_cuts_a_quarter_rounded_down(pool: list[float], iqm: float) -> None:
    assert summarise(np.array(pool)).iqm == pytest.approx(iqm)


def test_percentile_interpolates_between_two() -> None:
    assert summarise(np.array([10.0, 0.0])).tenth_percentile == pytest.approx(1.0)


def test_a_single_policy_has_no_spread() -> None:
    found = summarise(np.array([-7.0]))
    assert (found.std, found.standard_error) == (0.0, 0.0)
    assert found.tenth_percentile == found.mean == found.iqm == -7.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_policy_that_is_not_finite_is_shown(bad: float) -> None:
    found = summarise(np.array([-1.0, bad, -2.0])).as_dict()
    assert found.pop("policies") == 3
    assert set(found) == {"tenth_percentile", "standard_error", "mean", "std", "iqm"}
    assert all(math.isnan(value) for value in found.values())


def test_order_does_not_matter() -> None:
    pool = np.random.default_rng(0).normal(size=20)
    one, other = (dataclasses.astuple(summarise(p)) for p in (pool, pool[::-1].copy()))
    assert one == pytest.approx(other)


def test_pool_takes_the_last_snapshots_of_every_seed_in_order() -> None:
    first = np.arange(4 * 2 * 3, dtype=np.float64).reshape(4, 2, 3)  # [S, N, trajectories]
    pool = pool_policies([first, first + 100.0], 2)
    assert pool.shape == (4, 2)
    assert pool.tolist() == [[13.0, 16.0], [19.0, 22.0], [113.0, 116.0], [119.0, 122.0]]


def test_seeds_may_have_different_numbers_of_snapshots() -> None:
    pool = pool_policies([np.zeros((5, 1, 2)), np.ones((2, 1, 2))], 2)
    assert pool[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("last", [0, 3])
def test_pools_need_enough_snapshots(last: int) -> None:
    with pytest.raises(ValueError, match=f"the last {last} snapshots, but a seed has 2"):
        pool_policies([np.zeros((5, 1)), np.zeros((2, 1))], last)
