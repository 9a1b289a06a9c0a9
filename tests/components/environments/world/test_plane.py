"""The 2-D world: positions, rewards, starts and what it refuses."""

import math

import numpy as np
import pytest

from components.environments.systems import WORLD, make_batch
from components.environments.world.plane import CENTRE, SIDE, Plane, reward_at


def test_the_reward_is_a_gaussian_around_the_centre_with_maximum_one() -> None:
    assert reward_at(CENTRE) == 1.0
    places = [[3.0, 6.0], [4.5, 6.0], [3.0, 3.0], [2.5, 2.5], [0.0, 10.0]]
    # by hand: squared distances in units of 1.5 are 0, 1, 4, 50 / 9 and 100 / 9
    expected = [1.0, math.exp(-0.5), math.exp(-2.0), math.exp(-25 / 9), math.exp(-50 / 9)]
    np.testing.assert_allclose(reward_at(places), expected, rtol=1e-12)  # rounding


def test_a_step_adds_the_clipped_action_and_pays_for_the_new_position() -> None:
    plane = Plane(3)
    plane.reset(np.random.default_rng(0), start={"x": [3.0, 0.0, 9.5], "y": [5.5, 1.0, 9.5]})
    positions, rewards = plane.step([[0.0, 0.5], [5.0, -0.25], [1.0, 1.0]])
    np.testing.assert_array_equal(positions, [[3.0, 6.0], [1.0, 0.75], [10.5, 10.5]])
    np.testing.assert_array_equal(rewards, reward_at(positions))
    assert not plane.terminated.any()


def test_positions_are_not_clipped() -> None:
    plane = Plane(2)
    plane.reset(np.random.default_rng(0), start={"x": [0.5, 9.5], "y": 5.0})
    for _ in range(30):
        positions, rewards = plane.step([[-1.0, 0.0], [1.0, 0.0]])
    assert positions[:, 0].tolist() == [-29.5, 39.5]
    assert (rewards < 1e-30).all()


def test_starts_are_uniform_in_the_square_and_belong_to_the_generator() -> None:
    plane = Plane(20_000)
    first = plane.reset(np.random.default_rng(5))
    assert np.array_equal(first, Plane(20_000).reset(np.random.default_rng(5)))
    assert ((first >= 0.0) & (first < SIDE)).all()
    # seven standard errors of a mean and of a share of 20,000
    np.testing.assert_allclose(first.mean(axis=0), SIDE / 2, atol=7 * SIDE / math.sqrt(12 * 20_000))
    corner = (first < SIDE / 4).all(axis=1).mean()
    assert corner == pytest.approx(1 / 16, abs=7 * math.sqrt(1 / 16 / 20_000))


def test_some_agents_start_again_while_the_others_stay() -> None:
    plane = Plane(3)
    before = plane.reset(np.random.default_rng(0))
    mask = np.array([True, False, True])
    fresh = plane.reset_copies(mask, np.random.default_rng(1), start={"y": [1.0, 2.0]})
    after, _ = plane.step(np.zeros((3, 2)))
    np.testing.assert_array_equal(after[mask], fresh)
    np.testing.assert_array_equal(after[1], before[1])
    assert fresh[:, 1].tolist() == [1.0, 2.0]


def test_what_a_caller_keeps_does_not_change() -> None:
    plane = Plane(1)
    start = plane.reset(np.random.default_rng(0))
    kept = start.copy()
    moved, _ = plane.step([[1.0, 1.0]])
    moved[:] = 0.0
    assert np.array_equal(start, kept)
    assert np.array_equal(plane.step([[0.0, 0.0]])[0], kept + 1.0)


def test_what_cannot_be_is_refused() -> None:
    plane = Plane(2)
    with pytest.raises(ValueError, match="before reset"):
        plane.step(np.zeros((2, 2)))
    rng = np.random.default_rng(0)
    for start, message in (
        ({"z": 1.0}, "unknown start value 'z'; known are x, y"),
        ({"x": [1.0, 2.0, 3.0]}, "one for each of 2 copies"),
        ({"x": math.nan}, "must be a finite number"),
    ):
        with pytest.raises(ValueError, match=message):
            plane.reset(rng, start=start)
    before = plane.reset(rng)
    with pytest.raises(ValueError, match=r"shape \(2,\); 2 copies need \(2, 2\)"):
        plane.step(np.zeros(2))
    with pytest.raises(ValueError, match="not a number; the copies did not move"):
        plane.step([[0.0, math.nan], [1.0, 0.0]])
    assert np.array_equal(plane.step(np.zeros((2, 2)))[0], before)
    with pytest.raises(ValueError, match="at least 1"):
        Plane(0)
    with pytest.raises(ValueError, match="has no parameter 'sigma'; it has none"):
        make_batch(WORLD.id, 2, sigma=2.0)
