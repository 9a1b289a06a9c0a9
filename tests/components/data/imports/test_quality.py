"""What looks wrong in a log, and what merely looks as logs do."""

import numpy as np
import pytest

from components.data.imports.jumps import find_jump
from components.data.imports.quality import reward_explained


def noise(rows: int = 5000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 1, rows).astype(np.float32)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: (20 + x) * 1.8 + 32, "median"),  # degrees
        (lambda x: (20 + x) * 1000, "median"),
        (lambda x: x * 1000, "spread"),  # about 0: the median stays
        (lambda x: 20 + x / 1000, "spread"),
    ],
)
def test_a_change_of_units_is_found_where_it_happens(change, said: str) -> None:
    values = noise() if said == "spread" and change(0.0) == 0 else noise() + 20
    later = noise(seed=1)
    values[3000:] = change(later)[3000:]
    jump = find_jump(values)
    assert jump.kind == said
    assert abs(jump.row - 3000) <= 2 * len(values) / 48  # a part of the log


def test_noise_drifts_seasons_and_single_outliers_are_no_change_of_units() -> None:
    time = np.linspace(0, 1, 5000, dtype=np.float32)
    for values in (
        noise(),
        noise() + 30 * time,
        noise() + 10 * np.sin(20 * time),
        np.where(time == time[3000], 1e6, noise()).astype(np.float32),
        np.repeat(noise(50), 100) + noise() / 10,  # a set point for every episode
        noise(100),
    ):
        assert find_jump(values) is None


def test_the_share_of_the_reward_that_features_explain() -> None:
    frames = np.stack([noise(1002), noise(1002, 1)], axis=1)
    arrays = {
        "frames": frames,
        "actions": noise(1000, 2)[:, None].clip(-1, 1),
        "episode_starts": np.array([0, 500, 1000]),
    }
    after = np.concatenate([frames[1:501], frames[502:]])
    assert reward_explained({**arrays, "rewards": 3 * after[:, 0] - after[:, 1] ** 2}) > 0.999
    # adjusted for its 11 terms, so about 0 for a reward of noise; its deviation is sqrt(2*11)/1000
    assert abs(reward_explained({**arrays, "rewards": noise(1000, 9)})) < 0.03
    assert reward_explained({**arrays, "rewards": np.ones(1000)}) is None
