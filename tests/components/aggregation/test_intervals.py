"""Intervals in which seeds are drawn whole, against every possible draw."""

from itertools import product

import numpy as np
import pytest

from components.aggregation.intervals import seed_interval

POOL = np.random.default_rng(3).normal(size=(3, 2, 4)) - 70.0  # three seeds, two snapshots


def test_the_interval_is_that_of_all_draws_of_three_seeds() -> None:
    low, high = seed_interval(POOL)
    draws = [POOL[list(rows)].reshape(6, 4) for rows in product(range(3), repeat=3)]
    every = np.array([np.percentile(draw, 10, axis=0) for draw in draws])  # all 27 are as likely
    # 2 * 2.5 % of 27 draws is less than one draw at either end: the extremes, with 3^-3 > 2.5 %.
    assert low == pytest.approx(every.min(axis=0))
    assert high == pytest.approx(every.max(axis=0))


def test_snapshots_of_a_seed_count_once() -> None:
    twins = np.repeat(POOL[:, :1], 2, axis=1)  # both snapshots the same
    often = np.repeat(POOL[:, :1], 50, axis=1)
    narrow = np.diff(seed_interval(often), axis=0)
    # A hundred and fifty policies of three seeds know no more than six do.
    assert narrow == pytest.approx(np.diff(seed_interval(twins), axis=0), rel=0.25)
    assert (narrow > 0).all()


def test_what_has_no_interval() -> None:
    for ends in seed_interval(POOL[:1]):
        assert np.isnan(ends).all()  # one seed tells no spread
    broken = POOL.copy()
    broken[1, 0, 2] = np.nan
    for ends in seed_interval(broken):
        assert np.isnan(ends).tolist() == [False, False, True, False]
    for ends in seed_interval(np.full_like(POOL, -np.inf)):
        assert np.isnan(ends).all()
    assert seed_interval(POOL[:, :, 0])[0].shape == ()


def test_the_same_numbers_give_the_same_interval() -> None:
    for first, second in zip(seed_interval(POOL), seed_interval(POOL), strict=True):
        assert (first == second).all()
