"""The autopilot on systems whose curve is known: what it promises, and how often it errs."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binom

from components.evaluation.autopilot import Autopilot, AutopilotConfig, fly

Curve = Callable[[float], float]


def flight(
    curve: Curve, noise: float, seed: int, config: AutopilotConfig
) -> tuple[Autopilot, list[float]]:
    """A search to its end, and the true means where it made trajectories."""
    rng, means = np.random.default_rng(seed), []

    def make(proximity: float) -> float:
        means.append(curve(proximity))
        return means[-1] + noise * rng.standard_normal()

    pilot = Autopilot(config)
    fly(pilot, make)
    return pilot, means


def cliff(proximity: float) -> float:
    """Rises by 10 until 0.5, then falls by 40 per unit."""
    return 20 * proximity if proximity <= 0.5 else 10 - 40 * (proximity - 0.5)


def test_without_noise_each_step_is_what_the_slope_allows() -> None:
    config = AutopilotConfig(
        budget=30, margin=2.0, slope=40.0, reference=0.0, noise=0.0, warm_up=1, step=1.0
    )
    pilot, _ = flight(cliff, 0.0, 0, config)
    places = [one.proximity for one in pilot.tried()]
    # From 0: 2 / 40 ahead. Then the return there, 1, adds 1 / 40.
    assert places[:3] == pytest.approx([0.0, 0.05, 0.125], abs=1e-8)
    # Past the peak, falling as fast as it may, a step ends on the floor of -2 itself: at 0.8.
    assert places[-1] == pytest.approx(0.8, abs=config.resolution)
    assert min(cliff(place) for place in places) >= -2.0 - 1e-9
    assert pilot.result().why == "nothing further is safe"


def test_a_rise_is_followed_to_the_end_by_the_longest_steps() -> None:
    config = AutopilotConfig(budget=60, margin=2.0, slope=10.0, noise=0.0, warm_up=1)
    pilot, _ = flight(lambda p: 5 * p, 0.0, 0, config)
    found = pilot.result()
    assert found.proximity == 1.0
    assert found.why == "proximity 1 is reached"
    assert found.trajectories == 21  # 0, 0.05 ... 1


def test_a_known_reference_keeps_a_clone_that_is_worse_where_it_is() -> None:
    config = AutopilotConfig(budget=20, margin=1.0, slope=10.0, reference=5.0, noise=0.1, warm_up=3)
    pilot, _ = flight(lambda p: 5 * p, 0.1, 0, config)
    assert pilot.result().trajectories == 3
    assert [one.proximity for one in pilot.tried()] == [0.0]


def test_bounds_are_narrowed_where_noise_hides_what_is_safe() -> None:
    config = AutopilotConfig(
        budget=200, margin=2.0, slope=40.0, reference=0.0, noise=2.0, warm_up=1
    )
    pilot, _ = flight(cliff, 2.0, 1, config)
    clone = pilot.tried()[0]
    assert len(clone.returns) > 1  # a single trajectory says too little to go on
    assert pilot.tried()[-1].proximity > 0
    assert clone.mean - clone.width > -2.0


@pytest.mark.parametrize("reference", [0.0, None])
def test_how_often_it_goes_below_the_floor(reference: float | None) -> None:
    # Worst cases of the assumption: a fall at exactly the slope, at once or behind a peak.
    risk, flights = 0.1, 60
    config = AutopilotConfig(
        budget=30, margin=6.0, slope=40.0, risk=risk, reference=reference, step=0.1
    )
    below = 0
    for seed in range(flights):
        curve: Curve = cliff if seed % 2 else lambda p: -40 * p
        pilot, means = flight(curve, 1.0, seed, config)
        below += min(means) < -6.0 or curve(pilot.result().proximity) < -6.0
    # With the stated risk more would be seen in one case of a thousand.
    assert below <= binom.ppf(0.999, flights, risk)


def test_a_slope_that_is_too_small_is_no_guarantee() -> None:
    # The floor is missed where the assumption fails, else the test above would show nothing.
    config = AutopilotConfig(budget=30, margin=2.0, slope=4.0, noise=0.1, step=0.2)
    _, means = flight(lambda p: 0.0 if p < 0.3 else -50.0, 0.1, 0, config)
    assert min(means) == -50.0


def test_it_is_a_state_machine_that_refuses_what_it_cannot_use() -> None:
    pilot = Autopilot(AutopilotConfig(budget=3, margin=1.0, slope=1.0, warm_up=2))
    with pytest.raises(ValueError, match="Nothing was tried"):
        pilot.result()
    with pytest.raises(ValueError, match="ask propose"):
        pilot.tell(1.0)
    assert pilot.propose() == pilot.propose() == 0.0
    with pytest.raises(ValueError, match="must be a number"):
        pilot.tell(math.nan)
    pilot.tell(1.0)
    assert pilot.result().why == "not over"
    assert pilot.result().lower == -math.inf  # one trajectory tells nothing about the noise


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"warm_up": 31}, "warm_up must be at least 2"),
        ({"margin": 0.0}, "margin must be a positive"),
        ({"slope": math.inf}, "slope must be a positive"),
        ({"risk": 1.0}, "risk must lie"),
        ({"step": 0.005}, "resolution <= step"),
        ({"noise": -1.0}, "noise must be"),
        ({"reference": math.nan}, "reference must be"),
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AutopilotConfig(**{"budget": 30, "margin": 1.0, "slope": 1.0} | wrong)
