"""A short real run on every robot: logged, learned from, judged on the robot itself.

Mean returns of the learned policies and of the noisy behaviour, measured: 23.9 and 20.7 on Swimmer,
115.2 and 98.5 on Hopper, 78.5 and 54.0 on Walker2D. By the spread of the five seeds (0.6, 1.4 and
6.1) and of the logged episodes, the chance that five others do not beat the behaviour is below one
in a thousand for each (t-test, four degrees of freedom). On one machine nothing is left to chance.
"""

from pathlib import Path
from typing import Any

import pytest

from components.core.files import read_json
from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from tests.flows.grid import finished

WORDS = [
    "algorithms=[td3_bc]", "seeds=[0,1,2,3,4]", "data.transitions=100000",
    "training.snapshots=10", "evaluation.trajectories=20", "aggregation.pool_fraction=0.5",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "updates"), [("swimmer", 2000), ("hopper", 2000), ("walker2d", 4000)]
)
def test_learning_beats_what_was_logged(robot: str, updates: int, tmp_path: Path) -> None:
    chosen = [f"datasets=[{robot}]", f"algorithm.td3_bc.updates={updates}"]
    plan = benchmark_plan(load_settings([*WORDS, *chosen]))
    store = finished(plan, tmp_path)

    def metrics(component: str) -> Any:
        [node] = [node for node in plan if node.component == component]
        return read_json(store.path(node.key) / "metrics.json")

    logged = metrics("data_generation")["return/first_window_mean"]
    learned = metrics("aggregation")["mean"]
    assert learned > logged
