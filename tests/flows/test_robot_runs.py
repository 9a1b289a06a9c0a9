"""Short real runs on the robots: logged, learned from, judged on the robot itself."""

from pathlib import Path

import pytest

from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from tests.flows.grid import finished, metrics

SEEDS = ["seeds=[0,1,2,3,4]", "evaluation.trajectories=20", "aggregation.pool_fraction=0.5"]
SHORT = [
    "algorithms=[bc,td3_bc]", "data.transitions=50000", "training.snapshots=8",
    "model.behaviour_policy.epochs=1",
    "algorithm.bc.updates=2000", "algorithm.bc.hidden=[64,64]", "algorithm.bc.learning_rate=1e-3",
    "algorithm.td3_bc.updates=3000", "algorithm.td3_bc.hidden=[64,64]",
    "algorithm.td3_bc.learning_rate=1e-3",
]  # fmt: skip
LONGER = ["algorithms=[td3_bc]", "data.transitions=100000", "training.snapshots=10"]


@pytest.mark.slow(60)
def test_values_lead_beyond_the_clone(tmp_path: Path) -> None:
    """The Walker, the robot whose clone is furthest from its learners.

    @@
    """
    plan = benchmark_plan(load_settings([*SEEDS, *SHORT, "datasets=[walker2d]"]))
    store = finished(plan, tmp_path)
    logged = metrics(plan, store, "data_generation")["return/first_window_mean"]
    clone = metrics(plan, store, "aggregation", "bc")["mean"]
    learned = metrics(plan, store, "aggregation", "td3_bc")["mean"]
    assert learned > max(logged, clone) + 0.0


@pytest.mark.exhaustive
@pytest.mark.slow(160)
@pytest.mark.parametrize(
    ("robot", "updates"), [("swimmer", 2000), ("hopper", 2000), ("walker2d", 4000)]
)
def test_learning_beats_what_was_logged(robot: str, updates: int, tmp_path: Path) -> None:
    """On every robot, at the default sizes of the networks.

    Mean returns of the learned policies and of the noisy behaviour, measured: 23.9 and 20.7 on
    Swimmer, 115.2 and 98.5 on Hopper, 78.5 and 54.0 on Walker2D. By the spread of the five seeds
    (0.6, 1.4 and 6.1) and of the logged episodes, the chance that five others do not beat the
    behaviour is below one in a thousand for each (t-test, four degrees of freedom). A clone beats
    the behaviour of Swimmer and Hopper, too.
    """
    chosen = [f"datasets=[{robot}]", f"algorithm.td3_bc.updates={updates}"]
    plan = benchmark_plan(load_settings([*SEEDS, *LONGER, *chosen]))
    store = finished(plan, tmp_path)
    logged = metrics(plan, store, "data_generation")["return/first_window_mean"]
    assert metrics(plan, store, "aggregation")["mean"] > logged
