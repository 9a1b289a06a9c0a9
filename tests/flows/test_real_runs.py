"""A short real run on the Industrial Benchmark, evaluated on the real simulator."""

from pathlib import Path

import pytest

from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from tests.flows.grid import finished, metrics

WORDS = [
    "datasets=[bad-0.4]", "algorithms=[bc,bcq,wsbc]", "seeds=[0,1,2,3,4]", "data.trajectories=30",
    "training.snapshots=10", "evaluation.trajectories=10", "aggregation.pool_fraction=0.5",
    "algorithm.bc.updates=500", "algorithm.bcq.updates=2000", "algorithm.bcq.hidden=[64,64]",
    "algorithm.bcq.vae_hidden=[100]", "algorithm.wsbc.updates=20", "algorithm.wsbc.starts=20",
    "algorithm.wsbc.particles=30", "algorithm.wsbc.neighbourhood=5", "algorithm.wsbc.horizon=50",
    "algorithm.wsbc.velocity_limit=1.0",
    "model.behaviour_policy.epochs=10", "model.recurrent_ensemble.updates=200",
    "model.recurrent_ensemble.members=2",
]  # fmt: skip


@pytest.mark.slow(60)
def test_bcq_and_wsbc_beat_a_bad_log_and_its_clone(tmp_path: Path) -> None:
    """Neither passes by copying: BCQ chooses by its critics, WSBC begins at the clone's weights.

    So with a critic, a swarm or an ensemble that learns nothing, policies stay where the clone is.
    60 s on one core (of a shared virtual computer), where all this was measured. Means over the
    last half of the snapshots (deviation of the five seeds): the log -208, the clone -216 (4), BCQ
    -181 (9), WSBC -109 (9); with data.seed 1 and 2 the log -212 and -212, the clone -220 (8) and
    -219 (13), WSBC -102 (6) and -109 (8). The velocity limit is ten times
    the default, which is made for a hundred iterations; here are twenty.

    By t-tests with four degrees of freedom, the chance that five other seeds do not lead by what is
    asked for is for WSBC below one in a thousand on all three logs (it leads by 99, 110 and 103,
    standard errors at most 4.0, and 50 are asked for); for BCQ below one in a hundred (it leads
    the clone by 36 with a standard error of 4.5, the log by 28 with 4.1, and 10 are asked for). On
    one computer the runs are reproducible.
    """
    plan = benchmark_plan(load_settings(WORDS))
    store = finished(plan, tmp_path)
    logged = metrics(plan, store, "data_generation")["return/first_window_mean"]
    clone, values, swarm = (
        metrics(plan, store, "aggregation", algorithm)["mean"]
        for algorithm in ("bc", "bcq", "wsbc")
    )
    assert values > max(logged, clone) + 10.0
    assert swarm > max(logged, clone) + 50.0
