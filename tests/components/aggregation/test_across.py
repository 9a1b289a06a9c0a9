"""Comparing algorithms over datasets, by hand."""

import numpy as np
import pytest

from components.aggregation.across import (
    improvement,
    interquartile_mean,
    mean_ranks,
    profile,
    score,
)

LOW = [np.array([0.1, 0.2]), np.array([0.3, 0.4])]
HIGH = [np.array([0.15, 0.9]), np.array([0.8, 0.8])]


def test_scores_lie_between_floor_and_best_and_divergence_is_the_floor() -> None:
    returns = np.array([-350.0, -60.0, -205.0, np.nan, -np.inf])
    assert score(returns, -350.0, -60.0) == pytest.approx([0.0, 1.0, 0.5, 0.0, 0.0])


def test_the_middle_half_of_all_runs() -> None:
    found = interquartile_mean([np.array([0.0, 0.4, 0.6, 100.0]), np.array([0.2, 0.5, 0.7, -9.0])])
    assert found.value == pytest.approx(np.mean([0.2, 0.4, 0.5, 0.6]))
    assert found.low < found.value < found.high


def test_seeds_are_drawn_within_their_dataset() -> None:
    # Every dataset has one value only: whatever is drawn, the middle is the same.
    found = interquartile_mean([np.array([0.1, 0.1]), np.array([0.9, 0.9])])
    assert (found.low, found.high) == pytest.approx((0.5, 0.5))


def test_profiles_fall_with_the_threshold() -> None:
    found = profile(LOW, np.array([0.0, 0.15, 0.35, 0.4]))
    assert found.value.tolist() == [1.0, 0.75, 0.25, 0.0]
    assert (found.low <= found.value).all()
    assert (found.value <= found.high).all()


def test_improvement_counts_wins_per_dataset_and_ties_half() -> None:
    found = improvement(HIGH, LOW)
    # First dataset: 0.15 beats 0.1 alone, 0.9 both: 3 of 4. Second: all.
    assert found.value == pytest.approx((0.75 + 1.0) / 2)
    assert found.low <= found.value <= found.high
    assert improvement(LOW, HIGH).value == pytest.approx(1 - found.value)
    assert improvement(LOW, LOW).value == pytest.approx(0.5)


def test_a_single_seed_has_no_interval() -> None:
    found = improvement([np.array([0.2])], [np.array([0.1])])
    assert found.value == 1.0
    assert np.isnan([found.low, found.high]).all()


def test_ranks_and_the_critical_difference_of_demsar() -> None:
    values = np.array([[3.0, 2.0, 1.0], [3.0, 2.0, np.nan], [2.0, 2.0, 1.0]])
    found = mean_ranks(values)
    assert found.mean == pytest.approx([(1 + 1 + 1.5) / 3, (2 + 2 + 1.5) / 3, 3.0])
    # Demšar 2006, table 5: q_0.05 = 2.343 for three classifiers.
    assert found.critical_difference == pytest.approx(2.343 * np.sqrt(3 * 4 / (6 * 3)), abs=1e-3)
    assert 0.0 < found.p_value < 0.2


def test_one_dataset_tells_no_significance() -> None:
    assert np.isnan(mean_ranks(np.array([[1.0, 2.0, 3.0]])).p_value)
