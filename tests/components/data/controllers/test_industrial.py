"""The three controllers against values worked out by hand."""

import numpy as np
import pytest

from components.data.controllers.industrial import (
    CONTROLLERS,
    bad,
    epsilon_greedy,
    mediocre,
    optimized,
)


def history(**lagged: dict[int, float]) -> np.ndarray:
    """A history at setpoint 70, everything else zero except the given values at given lags."""
    columns = {"velocity": 1, "gain": 2, "shift": 3, "fatigue": 4}
    frames = np.zeros((1, 30, 6))
    frames[:, :, 0] = 70.0
    for name, values in lagged.items():
        for lag, value in values.items():
            frames[0, lag, columns[name]] = value
    return frames


def test_bad_and_mediocre_act_on_raw_steerings_of_the_newest_frame() -> None:
    now = history(velocity={0: 99.5, 1: 0.0}, gain={0: 100.0}, shift={0: 20.0})
    np.testing.assert_allclose(bad(now), [[0.5, 0.0, 1.0]])
    now = history(velocity={0: 25.25}, gain={0: 90.0}, shift={0: 24.5})
    np.testing.assert_allclose(mediocre(now), [[-0.25, -1.0, 0.5]])


def test_optimized_reads_its_lags_and_scales() -> None:
    # velocity at lag 5, fatigue at lag 3, shift at lags 3 and 4; every other lag would shift them
    now = history(
        velocity={5: 48.75 - 0.5 * 12.31, 4: 1e3, 6: 1e3, 0: 1e3},
        fatigue={3: 37.51 - 0.25 * 31.17, 2: 1e3, 4: 1e3},
        shift={3: 49.45 + 0.5 * 29.22, 4: 49.45 + 0.6 * 29.22, 2: 1e3, 5: 1e3},
    )
    setpoint = 15.0 / 28.72
    expected = [
        0.5 - 0.91,
        -0.5 - setpoint + 1.43,
        -3.48 * 0.5 - 0.6 + 2.0 * setpoint + 0.81,
    ]
    np.testing.assert_allclose(optimized(now), [expected], rtol=1e-12)


def test_optimized_is_clipped() -> None:
    now = history(velocity={5: 100.0}, fatigue={3: 300.0}, shift={3: 0.0, 4: 0.0})
    assert optimized(now).tolist() == [[-1.0, 1.0, 1.0]]


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_controllers_treat_copies_alike_and_leave_the_history(name: str) -> None:
    frames = np.random.default_rng(0).uniform(0.0, 100.0, (8, 30, 6))
    before = frames.copy()
    together = CONTROLLERS[name](frames)
    apart = np.concatenate([CONTROLLERS[name](frames[k : k + 1]) for k in range(8)])
    np.testing.assert_array_equal(together, apart)
    np.testing.assert_array_equal(frames, before)
    assert together.shape == (8, 3)
    assert np.abs(together).max() <= 1.0


def test_epsilon_greedy_replaces_whole_vectors_at_the_right_rate() -> None:
    rng = np.random.default_rng(0)
    actions = np.full((20_000, 3), 0.123)
    mixed = epsilon_greedy(actions, 0.2, rng)
    changed = mixed != actions
    assert (changed.all(axis=1) == changed.any(axis=1)).all()
    # five standard errors of a share of 0.2 in 20,000 draws
    assert changed[:, 0].mean() == pytest.approx(0.2, abs=5.0 * 0.4 / 20_000**0.5)
    explored = mixed[changed[:, 0]]
    assert np.abs(explored).max() <= 1.0
    assert np.abs(explored.mean(axis=0)).max() < 5.0 * 0.577 / len(explored) ** 0.5


@pytest.mark.parametrize(("epsilon", "kept"), [(0.0, True), (1.0, False)])
def test_epsilon_greedy_at_its_ends(epsilon: float, kept: bool) -> None:
    actions = np.zeros((1000, 3))
    mixed = epsilon_greedy(actions, epsilon, np.random.default_rng(1))
    assert ((mixed == 0.0).all(axis=1) == kept).all()
    assert mixed is not actions


def test_epsilon_greedy_draws_the_same_numbers_whatever_epsilon_is() -> None:
    after = []
    for epsilon in (0.0, 0.5, 1.0):
        rng = np.random.default_rng(2)
        epsilon_greedy(np.zeros((7, 3)), epsilon, rng)
        after.append(rng.random())
    assert after[0] == after[1] == after[2]
