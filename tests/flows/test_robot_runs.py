"""Short real runs on the robots: logged, learned from, evaluated on the robot itself."""

import dataclasses
from pathlib import Path

import pytest

from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from tests.flows.grid import finished, metrics

SEEDS = ["seeds=[0,1,2,3,4]", "evaluation.trajectories=20", "aggregation.pool_fraction=0.5"]
SHORT = [
    "algorithms=[bc,td3_bc]", "data.transitions=50000", "training.snapshots=8",
    "model.behaviour_policy.epochs=1",
    "algorithm.bc.updates=1000", "algorithm.bc.hidden=[64,64]", "algorithm.bc.learning_rate=1e-3",
    "algorithm.td3_bc.updates=1500", "algorithm.td3_bc.hidden=[64,64]",
    "algorithm.td3_bc.learning_rate=1e-3",
]  # fmt: skip
LONGER = ["algorithms=[td3_bc]", "data.transitions=100000", "training.snapshots=10"]


@pytest.mark.slow(40)
def test_values_lead_far_beyond_a_noisy_log_and_its_clone(tmp_path: Path) -> None:
    """Swimmer, logged with seven random actions in ten: 40 s on one core.

    The clone takes the mean of expert and random actions, a third of the expert's strokes, so
    copying does not pass: a dead critic stays at the clone. Means over the last four snapshots
    (deviation of the five seeds), measured: the log 8.9, the clone 11.9 (1.0), TD3+BC 22.3 (0.4);
    with data.seed 1 the log 9.8, the clone 12.3 (1.3), TD3+BC 22.4 (0.4). TD3+BC leads the clone by
    10 with a standard error of at most 0.6 and 5 are asked for: the chance that five other seeds
    lead by less is below one in a thousand (t-test, four degrees of freedom). On one machine
    nothing is left to chance.
    """
    settings = load_settings([*SEEDS, *SHORT, "datasets=[swimmer]"])
    noisy = {"swimmer": dataclasses.replace(settings.dataset["swimmer"], epsilon=0.7)}
    plan = benchmark_plan(settings.model_copy(update={"dataset": noisy}))
    store = finished(plan, tmp_path)
    logged = metrics(plan, store, "data_generation")["return/first_window_mean"]
    clone, learned = (
        metrics(plan, store, "aggregation", algorithm)["mean"] for algorithm in ("bc", "td3_bc")
    )
    assert learned > max(logged, clone) + 5.0


@pytest.mark.exhaustive
@pytest.mark.slow(160)
@pytest.mark.parametrize(
    ("robot", "updates"),
    [
        ("swimmer", 2000),
        ("hopper", 2000),
        pytest.param("walker2d", 8000, marks=pytest.mark.slow(320)),
    ],
)
def test_learning_beats_what_was_logged(robot: str, updates: int, tmp_path: Path) -> None:
    """On every robot, at the default sizes of the networks.

    Mean returns of the learned policies and of the noisy behaviour, measured: 23.9 and 20.7 on
    Swimmer, 115.2 and 98.5 on Hopper, 119.7 and 87.3 on Walker2D. By the spread of the five seeds
    (0.6, 1.4 and 1.6) and of the logged episodes, the chance that five others do not beat the
    behaviour is below one in a thousand for each (t-test, four degrees of freedom). A clone beats
    the behaviour of Swimmer and Hopper, too.
    """
    chosen = [f"datasets=[{robot}]", f"algorithm.td3_bc.updates={updates}"]
    plan = benchmark_plan(load_settings([*SEEDS, *LONGER, *chosen]))
    store = finished(plan, tmp_path)
    logged = metrics(plan, store, "data_generation")["return/first_window_mean"]
    assert metrics(plan, store, "aggregation")["mean"] > logged
