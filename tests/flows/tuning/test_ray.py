"""The real thing: trials in Ray's workers, and a driver that is killed and started again."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from optuna.trial import TrialState

from flows.pipeline.store import ArtifactStore
from flows.tuning.mlflow_trials import MlflowTrials
from flows.tuning.study import _COMPARED_FROM, _PATIENCE, has_ended
from tests.flows.pipeline.toys import counted, wait_for
from tests.flows.tuning.toys import STEPS, specification, study

TRIALS = _COMPARED_FROM + 3


def start(home: Path, log: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.flows.tuning.ray_driver", str(home), str(log)]
    return subprocess.Popen(
        [*command, str(TRIALS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"RAY_ADDRESS": "", "MLFLOW_TRACKING_URI": ""},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.mark.slow(40)
def test_a_killed_search_continues_and_pruned_trials_stop_in_ray_s_workers(tmp_path: Path) -> None:
    home, log = tmp_path / "mlruns", tmp_path / "log"
    log.mkdir()
    made = study(home, log)
    made.recover()
    for k in range(_COMPARED_FROM):
        made._study.enqueue_trial({"x": 0.31 + 0.01 * k, "mood": "good"})
    made._study.enqueue_trial({"x": 0.5, "mood": "bad"})
    bad = specification(log).node_of({"x": 0.5, "mood": "bad"}, 0)

    (log / "hold").touch()
    with start(home, log) as driver:
        # Both slots are at work: two fits stand still in the middle.
        wait_for(lambda: counted(log, "holding") >= 2, "two fits in the middle")
        driver.kill()
    assert [t.state.name for t in study(home, log).trials()[:3]] == ["RUNNING"] * 2 + ["WAITING"]
    kept = [t.user_attrs["key"] for t in study(home, log).trials()[:2]]
    steps = {key: counted(log, f"step-{key}") for key in kept}
    assert set(steps.values()) == {6}

    (log / "go").touch()
    (log / f"slow-{bad.key}").touch()  # so that the driver can prune it before it is done
    with start(home, log) as driver:
        out, text = driver.communicate(timeout=300)
    assert (driver.returncode, out) == (0, ""), text
    made = study(home, log)
    trials = made.trials()
    assert made.ended == TRIALS
    assert [t.state.name for t in trials[:2]] == ["FAIL"] * 2
    assert not any(has_ended(t) for t in trials[:2])
    ended = [t for t in trials if has_ended(t)]
    assert len({t.user_attrs["key"] for t in ended}) == TRIALS
    for key in kept:
        # Continued from its checkpoint: at most the step in progress is done again; not even that
        # if the killed driver's worker lived long enough to go on by itself.
        assert counted(log, f"step-{key}") in (STEPS, STEPS + 1)
        assert counted(log, f"finished-{key}") == 1
    [pruned] = [t for t in trials if t.user_attrs.get("key") == bad.key]
    assert pruned.state is TrialState.PRUNED
    assert pruned.user_attrs["given_up"] >= _PATIENCE
    assert counted(log, f"step-{bad.key}") < STEPS
    assert list(ArtifactStore(home).work.iterdir()) == []
    assert list((home / "progress").iterdir()) == []
    runs = MlflowTrials(home).experiment.search(f"tags.study = '{made.name}'")
    assert sorted(int(run.data.tags["trial"]) for run in runs) == [t.number for t in trials]
