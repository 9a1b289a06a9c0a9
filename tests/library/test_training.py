"""Training by the library: the policies of a sweep, all algorithms, refusals, no orchestration."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import proximity_bench as pb
from components.algorithms import ALGORITHMS
from components.policies.policy import Policy as StoredPolicy
from components.training.divergence import DivergedError
from flows.configuration.settings import load_settings
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import NullTracker
from flows.planning.benchmark import benchmark_plan
from proximity_bench.progress import progress_bars
from tests.components.algorithms.stacks import PLAIN, SMALL
from tests.components.synthetic import make_log
from tests.conftest import ROOT

LOG = make_log()
MODELS: dict[str, dict[str, Any]] = {
    "behaviour_policy": {"hidden": [8], "epochs": 1, "batch": 16},
    "action_vae": {"hidden": [8], "epochs": 1, "batch": 16},
    "recurrent_ensemble": {
        "members": 2, "hidden": 4, "warm_up": 3, "horizon": 5, "updates": 4, "batch": 8,
        "validate_every": 2,
    },
    "deterministic_ensemble": {"members": 2, "hidden": [8], "epochs": 1, "batch": 16},
    "gaussian_ensemble": {"members": 3, "elites": 2, "hidden": [8, 8], "epochs": 1, "batch": 16},
    "residual_ensemble": {"members": 2, "hidden": [8], "epochs": 1, "batch": 16},
}  # fmt: skip


def trained(algorithm: str, **options: Any) -> Any:
    """The algorithm, small, on the small machine's log."""
    small = SMALL.get(algorithm, PLAIN) | {"updates": 6} | options
    models = {name: MODELS[name] for name in ALGORITHMS[algorithm].needs}
    return pb.train(LOG, algorithm, models=models, progress=False, **small)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_trains_and_acts(algorithm: str) -> None:
    policy = trained(algorithm, snapshots=2)
    proximity = 0.5 if ALGORITHMS[algorithm].takes_proximity else None
    action = policy.act(LOG.frames[:2], proximity)
    assert policy.steps[-1] - policy.steps[0] == 3
    assert action.shape == (3,)
    assert (np.abs(action) <= 1).all()


def test_lion_learns_in_the_models_that_it_is_told() -> None:
    asked = {name: MODELS[name] for name in ("behaviour_policy", "deterministic_ensemble")}
    small = SMALL["lion"] | {"updates": 6, "transition": "deterministic_ensemble"}
    policy = pb.train(LOG, "lion", models=asked, progress=False, **small)
    assert not np.array_equal(
        policy.act(LOG.frames[:2], 0.5), trained("lion").act(LOG.frames[:2], 0.5)
    )
    with pytest.raises(ValueError, match="its models are behaviour_policy, recurrent_ensemble, de"):
        pb.train(LOG, "lion", models={"action_vae": {}}, progress=False)


def nodes_of(plan: Sequence[Node], component: str) -> list[Node]:
    return [node for node in plan if node.component == component]


@pytest.mark.slow(4)
def test_the_policies_and_returns_are_those_of_a_sweep(tmp_path: Path) -> None:
    settings = load_settings(
        [
            "profile=smoke", "algorithms=[lion]", "seeds=[0,3]", "training.snapshots=1",
            "data.trajectories=4", "data.steps=110", "evaluation.horizon=10",
            "algorithm.lion.updates=4",
        ]
    )  # fmt: skip
    plan = benchmark_plan(settings)
    store = ArtifactStore(tmp_path / "mlruns")
    done = run_plan(plan, store, NullTracker(), Display(), executor=SerialExecutor())
    assert done.exit_code == 0

    log = pb.dataset("mediocre-0.2", trajectories=4, steps=110)
    models = {
        node.config["model"]: node.config["settings"] for node in nodes_of(plan, "model_fitting")
    }
    lion = asdict(settings.algorithm_on("mediocre-0.2", "lion"))
    policies = pb.train(
        log, "lion", seeds=[0, 3], models=models, snapshots=1, progress=False, **lion
    )
    found = {node.config["seed"]: node for node in nodes_of(plan, "policy_training")}
    returns = {node.config["stream"][2]: node for node in nodes_of(plan, "evaluation")}
    assert [policy.seed for policy in policies] == [0, 3]
    for policy in policies:
        stored = pb.load(store.path(found[policy.seed].key) / "policy")
        assert (stored.seed, stored.log) == (policy.seed, log.card)
        assert_equal(policy.stack, stored.stack)
        evaluated = np.load(store.path(returns[policy.seed].key) / "returns.npz")
        table = policy.evaluate(2, horizon=10, proximity_step=0.5, progress=False)
        np.testing.assert_array_equal(table.index, evaluated["lambdas"])
        np.testing.assert_array_equal(table["return"], evaluated["returns"][0].mean(axis=-1))
        np.testing.assert_array_equal(table["distance"], evaluated["distances"][0])


def assert_equal(one: StoredPolicy, other: StoredPolicy) -> None:
    assert one.card == other.card
    for name, tensor in one.tensors().items():
        torch.testing.assert_close(tensor, other.tensors()[name], rtol=0, atol=0)


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Configuration objects of the models that would have been fitted; training stops."""
    configs: dict[str, Any] = {}

    def fit(folder: Path, name: str, log: Any, config: Any, *rest: Any, **named: Any) -> None:
        configs[name] = config

    monkeypatch.setattr("proximity_bench.training.fit_into", fit)
    monkeypatch.setattr("proximity_bench.training.MODELS", {n: _Unread() for n in MODELS})
    monkeypatch.setattr("proximity_bench.training._train", stop)
    return configs


@pytest.mark.slow(2)
def test_settings_are_those_of_the_datasets_domain(fitted: dict[str, Any]) -> None:
    log = pb.dataset("hopper", transitions=1200, steps=120)
    with pytest.raises(StoppedError) as stopped:
        pb.train(
            log, "wsbc", models={"behaviour_policy": {"epochs": 3}}, updates=70, progress=False
        )
    sweep = load_settings(["datasets=[hopper]", "algorithms=[wsbc]", "algorithm.wsbc.updates=70"])
    assert stopped.value.settings.algorithm_on("hopper", "wsbc") == sweep.algorithm_on(
        "hopper", "wsbc"
    )
    assert fitted["recurrent_ensemble"] == sweep.model_on("hopper", "recurrent_ensemble")
    own = fitted["behaviour_policy"]
    assert (own.hidden, own.epochs) == ((40,), 3)  # WSBC's own clone, and what was given


def test_the_log_of_a_plant_has_the_settings_of_plants(fitted: dict[str, Any]) -> None:
    with pytest.raises(StoppedError):
        pb.train(make_log(episodes=4, steps=100), "lion", progress=False)
    assert fitted["recurrent_ensemble"].networks == "joint"  # its reward may depend on anything


class _Unread:
    def load(self, folder: Path) -> None:
        """Nothing was fitted."""


class StoppedError(Exception):
    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings


def stop(record: Any, log: Any, settings: Any, *rest: Any) -> None:
    raise StoppedError(settings)


@pytest.mark.parametrize(
    ("algorithm", "options", "reason"),
    [
        ("lino", {}, "Unknown algorithm 'lino'; valid ones are bc, .*Did you mean 'lion'"),
        ("bc", {"hiden": [3]}, "Unknown key 'algorithm.bc.hiden'.*Did you mean 'hidden'"),
        ("bc", {"updates": 1.5}, "algorithm.bc.updates=1.5: Input should be a valid integer"),
        ("bc", {"updates": 2, "snapshots": 5}, "updates=2 is less than training.snapshots=5"),
        ("bc", {"seeds": [0, 0]}, "must be a list of different whole numbers"),
        ("bc", {"seeds": -1}, "must hold whole numbers from 0"),
        ("bc", {"device": "gpu"}, "device='gpu' is unknown; give cpu, cuda or auto"),
        ("bc", {"models": {"behaviour_policy": {}}}, "bc is not trained with it; it needs no mod"),
        ("lion", {"models": {"recurent": {}}}, "Did you mean 'recurrent_ensemble'"),
        ("lion", {"models": {"behaviour_policy": {"x": 1}}}, "Unknown key .*behaviour_policy.x'"),
        ("lion", {}, "toy has 40 steps an episode, which is less than warm_up . horizon = 80"),
        ("lion", {"start_after": -1}, "algorithm.lion: start_after must not be negative"),
    ],
)
def test_what_cannot_be_is_one_sentence(algorithm: str, options: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        pb.train(LOG, algorithm, progress=False, **options)
    assert "\n" not in str(error.value)


def test_a_training_that_diverges_says_what_to_lower() -> None:
    with pytest.raises(ValueError, match=r"The training of bc on toy, seed 2 diverged: .*; lower"):
        trained("bc", learning_rate=1e38, seeds=2, snapshots=1)


def test_seeds_are_lanes_and_keep_their_order() -> None:
    policies = trained("bc", seeds=(4, 1))
    assert [policy.seed for policy in policies] == [4, 1]
    alone = trained("bc", seeds=1)
    # a seed that is trained alone differs from the same one in a stack by rounding
    np.testing.assert_allclose(alone.act(LOG.frames), policies[1].act(LOG.frames), atol=1e-4)
    assert not np.allclose(alone.act(LOG.frames), policies[0].act(LOG.frames), atol=1e-4)


@pytest.mark.slow(5)
def test_neither_ray_nor_mlflow_nor_hydra_is_imported() -> None:
    script = (
        "import json, sys\n"
        "import proximity_bench as pb\n"
        "log = pb.dataset('bad-0.4', trajectories=3, steps=40)\n"
        "policy = pb.train(log, 'bc', updates=2, hidden=[8], batch=8)\n"
        "policy.act(log.frames), policy.evaluate(2, horizon=3)\n"
        "print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT,
        env=os.environ,
    )  # fmt: skip
    loaded = set(json.loads(done.stdout))
    assert {"torch", "components", "proximity_bench"} <= loaded
    assert not loaded & {"ray", "mlflow", "hydra", "optuna", "minari"}
    assert done.stderr == ""  # no bars where there is no terminal


def test_of_several_seeds_the_finite_ones_are_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    found = trained("bc", seeds=[0, 1])
    ended = replace(found[0].stack, card=replace(found[0].stack.card, ended_at=4))
    lost = DivergedError("its loss was no longer finite at update 1")
    monkeypatch.setattr("proximity_bench.training._train", lambda *given: [ended, lost])
    with pytest.warns(UserWarning, match="seed") as told:
        [kept] = trained("bc", seeds=[0, 1])
    assert kept.stack is ended
    first, second = (str(warning.message) for warning in told)
    assert first.endswith("seed 0 diverged by update 4; the last finite policy stays.")
    assert "seed 1 diverged: its loss was no longer finite at update 1; lower" in second
    monkeypatch.setattr("proximity_bench.training._train", lambda *given: [lost, lost])
    with pytest.raises(ValueError, match="seed 0 diverged"):
        trained("bc", seeds=[0, 1])


def test_a_terminal_sees_a_bar_for_every_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as if it were one
    for shown in (True, False):
        with progress_bars(shown) as begin:
            begin("recurrent_ensemble")(0.5)
        assert ("recurrent_ensemble" in capsys.readouterr().err) is shown
