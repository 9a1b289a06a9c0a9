"""A short real run on the Industrial Benchmark: logged, learned from, judged on the real simulator."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.configuration.settings import load_settings
from flows.pipeline.files import read_json
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from tests.flows.grid import finished

WORDS = [
    "datasets=[bad-0.4]", "algorithms=[bc,wsbc]", "seeds=[0,1,2,3,4]", "data.trajectories=30",
    "training.snapshots=10", "evaluation.trajectories=10", "aggregation.pool_fraction=0.1",
    "algorithm.bc.updates=500", "algorithm.wsbc.updates=20", "algorithm.wsbc.starts=20",
    "algorithm.wsbc.particles=30", "algorithm.wsbc.neighbourhood=5", "algorithm.wsbc.horizon=50",
    "model.behaviour_policy.epochs=10", "model.recurrent_ensemble.updates=200",
    "model.recurrent_ensemble.members=2",
]  # fmt: skip


def stored(plan: Plan, store: ArtifactStore, component: str, algorithm: str | None = None) -> Any:
    """The metrics of the one node that is meant."""
    [node] = [
        node
        for node in plan
        if node.component == component and algorithm in (None, node.tags.get("algorithm"))
    ]
    return read_json(store.path(node.key) / "metrics.json")


@pytest.mark.slow(25)
def test_a_swarm_on_a_bad_log_leaves_the_log_and_its_clone_far_behind(tmp_path: Path) -> None:
    """WSBC begins at the clone's weights, so that a swarm or an ensemble that learns nothing fails.

    Measured with data.seed 0, 1 and 2 (two cores of a shared virtual machine, one thread): the log
    -208, -212 and -212, the clone -218, -222 and -228 (deviation of the seeds 29, 14 and 19), the
    swarm -88, -91 and -105 (4, 11 and 14). Half of the smallest of these margins, 107, is asked
    for. The standard error of a margin of five seeds each is at most 13 (29 and 4), so that others
    come out below half of it at t = 4 with four degrees of freedom, below one in a hundred; with
    the deviations of the other two logs (t = 7 and 5) below one in three hundred. On one machine
    nothing is left to chance.
    """
    plan = benchmark_plan(load_settings(WORDS))
    store = finished(plan, tmp_path)
    logged = stored(plan, store, "data_generation")["return/first_window_mean"]
    clone = stored(plan, store, "aggregation", "bc")["mean"]
    learned = stored(plan, store, "aggregation", "wsbc")["mean"]
    assert np.isfinite(learned)
    assert learned > max(logged, clone) + 53.0
