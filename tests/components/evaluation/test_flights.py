"""Searches on systems of measured returns."""

import numpy as np
import pytest

from components.evaluation.flights import MeasuredSystem, compare


def measured(curve: list[float], scatter: float = 0.0) -> MeasuredSystem:
    """Two trajectories at each place of an even grid, `scatter` above and below the curve."""
    means = np.array(curve)[:, None]
    return MeasuredSystem(np.linspace(0, 1, len(curve)), means + scatter * np.array([1.0, -1.0]))


def test_the_truth_of_a_measured_system() -> None:
    system = measured([-10.0, -6.0, -20.0], scatter=1.0)
    assert system.mean(0.25) == pytest.approx(-8.0, abs=1e-12)
    drawn = {round(system.trajectory(0.25, np.random.default_rng(n)), 9) for n in range(20)}
    assert drawn == {-7.0, -9.0}


def test_strategies_without_scatter() -> None:
    # The dip hides the peak from who stops at the first drop; it is shallower than the margin.
    curve = [-10.0, -9.0, -9.5, *np.linspace(-9.0, -5.0, 18)]
    found = compare(measured(curve), np.random.default_rng(0), repeats=1)
    [careful], [quick] = found.flights["autopilot"], found.flights["first drop"]
    assert (found.clone, found.best) == (-10.0, -5.0)
    assert (quick.proximity, quick.gain, quick.worst, quick.trajectories) == (0.05, 1.0, 0.0, 3)
    assert found.flights["first drop of 10"][0].trajectories == 30
    assert careful.proximity == 1.0
    assert careful.gain == pytest.approx(5.0, abs=1e-9)
    assert found.share_below("autopilot") == 0.0


def test_who_goes_below_the_margin_is_counted() -> None:
    found = compare(measured([-10.0, -14.0, -20.0]), np.random.default_rng(0), repeats=2)
    assert found.share_below("first drop") == 1.0
    # The fall is 8 per unit, less than the 40 that the autopilot expects: it stops on the way.
    assert found.share_below("autopilot") == 0.0
    assert all(-1.0 <= flight.worst <= 0.0 for flight in found.flights["autopilot"])
