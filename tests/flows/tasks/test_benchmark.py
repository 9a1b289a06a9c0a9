"""The task functions in a row, on tiny nodes: each from what the one before has stored."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.core.integrity import DamagedFileError
from components.core.tensors import load_tensors
from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.policies.policy import Policy
from components.training.divergence import DivergedError
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.task import Job, TaskContext, load_task
from flows.planning.benchmark import benchmark_plan

WORDS = [
    "profile=smoke", "datasets=[mediocre-0.2,bad-0.4]", "algorithms=[lion,td3_bc,brac,bcq]",
    "seeds=[0,3]", "data.trajectories=4",
    "data.steps=110", "evaluation.horizon=10",
]  # fmt: skip


def run(nodes: Sequence[Node], root: Path, where: str = "nodes") -> None:
    """One task call, as the pipeline makes it."""
    jobs = []
    for node in nodes:
        out = root / where / node.key
        out.mkdir(parents=True)
        inputs = {role: root / "nodes" / source.key for role, source in node.inputs.items()}
        config = json.loads(json.dumps(node.config))
        jobs.append(Job(node.key, node.name, config, inputs, out))
    work = root / "work" / where / nodes[0].key
    work.mkdir(parents=True)
    load_task(nodes[0].task)(jobs, TaskContext(work, [job.key for job in jobs]))


@pytest.fixture(scope="module")
def plan() -> Plan:
    return benchmark_plan(load_settings(WORDS))


@pytest.fixture(scope="module")
def root(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("store")
    groups: dict[str, list[Node]] = {}
    for node in plan:
        groups.setdefault(node.lanes or node.key, []).append(node)
    # A plan lists inputs first; a group is complete only where its last input is.
    order = {node.key: number for number, node in enumerate(plan)}
    stages = ["data_generation", "model_fitting", "policy_training", "evaluation", "aggregation"]
    for nodes in sorted(
        groups.values(), key=lambda g: (stages.index(g[0].component), order[g[0].key])
    ):
        run(nodes, folder)
    return folder


def out(plan: Plan, root: Path, name: str) -> Path:
    [node] = [node for node in plan if node.name == name]
    return root / "nodes" / node.key


def stored(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_every_node_says_what_it_measured(plan: Plan, root: Path) -> None:
    for node in plan:
        folder = root / "nodes" / node.key
        metrics = stored(folder / "metrics.json") if (folder / "metrics.json").exists() else {}
        numbers = [np.array(list(metrics.values()), dtype=float)]
        if (folder / "curves.npz").exists():
            with np.load(folder / "curves.npz", allow_pickle=False) as curves:
                numbers += [curves[name] for name in curves.files]
        assert sum(array.size for array in numbers) > 0, node.name
        assert all(np.isfinite(array).all() for array in numbers), node.name
        [entry] = stored(folder / "datasets.json")
        assert entry["name"] == node.tags["dataset"]


def test_data_generation(plan: Plan, root: Path) -> None:
    folder = out(plan, root, "data/bad-0.4")
    dataset = OfflineDataset.open(folder / "dataset")
    assert (dataset.episodes, dataset.transitions) == (4, 440)
    [entry] = stored(folder / "datasets.json")
    assert entry["name"] == "bad-0.4"
    assert dataset.card.digest.startswith(entry["digest"])


def test_model_fitting(plan: Plan, root: Path) -> None:
    clone = Policy.load(out(plan, root, "behaviour_policy/bad-0.4") / "model")
    assert (clone.card.algorithm, clone.lanes) == ("behaviour_policy", 1)
    folder = out(plan, root, "recurrent_ensemble/bad-0.4")
    assert RecurrentEnsemble.load(folder / "model").members == 2
    with np.load(folder / "curves.npz", allow_pickle=False) as curves:
        assert curves["model/validation_mse/fatigue0/step"].tolist() == [10, 20]


def test_a_model_of_another_seed_is_another_fit(plan: Plan, root: Path) -> None:
    [first] = [node for node in plan if node.name == "behaviour_policy/bad-0.4"]
    other = replace(first, config={**first.config, "seed": 1})
    run([first], root, "fitted-again")
    run([other], root, "fitted-otherwise")
    weights = [
        Policy.load(root / where / node.key / "model").layers[0][0]
        for where, node in (
            ("nodes", first),
            ("fitted-again", first),
            ("fitted-otherwise", other),
        )
    ]
    np.testing.assert_array_equal(weights[0], weights[1])
    # initial weights have a deviation of 0.04: those of other streams are nowhere near
    assert np.abs(weights[0] - weights[2]).mean() > 0.01


def test_policy_training(plan: Plan, root: Path) -> None:
    weights = []
    for seed in (0, 3):
        folder = out(plan, root, f"lion/bad-0.4/seed{seed}")
        policy = Policy.load(folder / "policy")
        assert policy.card.dataset == "bad-0.4"
        assert policy.card.takes_proximity
        assert policy.card.steps == (2, 4, 6, 8)
        weights.append(policy.layers[0][0])
        with np.load(folder / "curves.npz", allow_pickle=False) as curves:
            assert curves["policy/loss/step"].tolist() == list(range(1, 9))
    assert not np.array_equal(*weights)


def changed(plan: Plan, name: str, **settings: Any) -> Node:
    """A node with some other settings."""
    [node] = [node for node in plan if node.name == name]
    return replace(node, config=node.config | {"settings": node.config["settings"] | settings})


def failure(node: Node, root: Path, where: str) -> str:
    """What a node says that failed; it has stored nothing else."""
    [file] = (root / where / node.key).iterdir()
    assert file.name == "failure.txt"
    return file.read_text(encoding="utf-8")


def test_a_policy_that_diverges_fails_and_its_neighbour_does_not(
    plan: Plan, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = [changed(plan, f"td3_bc/bad-0.4/seed{s}", learning_rate=1e30) for s in (0, 3)]
    run(nodes, root, "diverged")
    for node in nodes:
        said = failure(node, root, "diverged")
        assert said.startswith(f"The training of {node.name} diverged: its loss or its policy was")
        assert said.endswith("; lower algorithm.td3_bc.learning_rate (now 1e+30).")
        assert "\n" not in said

    def refuse(*arguments: Any, **options: Any) -> None:
        raise DivergedError("it never began")

    monkeypatch.setattr("flows.tasks.policy_training.train_policies", refuse)
    run(nodes[:1], root, "refused")
    assert failure(nodes[0], root, "refused").startswith(
        "The training of td3_bc/bad-0.4/seed0 diverged: it never began; lower"
    )


def test_a_fit_that_diverges_fails(plan: Plan, root: Path) -> None:
    node = changed(plan, "recurrent_ensemble/bad-0.4", learning_rate=1e30)
    run([node], root, "diverged")
    assert failure(node, root, "diverged") == (
        "The fit of recurrent_ensemble on bad-0.4 diverged: its held-out loss was never finite; "
        "lower model.recurrent_ensemble.learning_rate (now 1e+30)."
    )


def test_a_fit_that_ends_early_says_when(
    plan: Plan, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [node] = [n for n in plan if n.name == "behaviour_policy/bad-0.4"]
    kind = MODELS["behaviour_policy"]

    def fit(*arguments: Any) -> Any:
        made = kind.fit(*arguments)
        return replace(made, ended_at=7, metrics=made.metrics | {"other": math.inf})

    monkeypatch.setattr(
        "components.models.fitting.MODELS", {"behaviour_policy": replace(kind, fit=fit)}
    )
    run([node], root, "ended")
    metrics = stored(root / "ended" / node.key / "metrics.json")
    assert (metrics["training/ended_at"], metrics["other"]) == (7, None)
    whole = stored(root / "nodes" / node.key / "metrics.json")
    assert "training/ended_at" not in whole
    assert metrics["validation_loss"] == whole["validation_loss"]


@pytest.mark.parametrize("harm", ["loss", "weights"])
def test_a_model_that_is_not_finite_is_not_stored(
    harm: str, plan: Plan, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [node] = [n for n in plan if n.name == "recurrent_ensemble/bad-0.4"]
    kind = MODELS["recurrent_ensemble"]

    def fit(*arguments: Any) -> Any:
        made = kind.fit(*arguments)
        if harm == "loss":
            return replace(made, validation_loss=math.inf)
        made.model.readout[0, 0, 0] = math.nan
        return made

    monkeypatch.setattr(
        "components.models.fitting.MODELS", {"recurrent_ensemble": replace(kind, fit=fit)}
    )
    run([node], root, f"not-finite-{harm}")
    said = (root / f"not-finite-{harm}" / node.key / "failure.txt").read_text()
    what = {"loss": "its held-out loss is inf", "weights": "the model is not finite in "}[harm]
    assert said.startswith(f"The fit of recurrent_ensemble on bad-0.4 diverged: {what}")


@pytest.mark.parametrize("algorithm", ["lion", "td3_bc"])
def test_stacks_over_datasets_train_what_stacks_over_seeds_train(
    algorithm: str, plan: Plan, root: Path
) -> None:
    nodes = [n for n in plan if n.tags.get("algorithm") == algorithm]
    nodes = [n for n in nodes if n.component == "policy_training"]
    assert len(nodes) == 4
    mixed = [nodes[2], nodes[0], nodes[3]]
    run(mixed, root, f"mixed-{algorithm}")
    for node in mixed:
        one = load_tensors(root / "nodes" / node.key / "policy" / "weights.safetensors")[0]
        two = load_tensors(
            root / f"mixed-{algorithm}" / node.key / "policy" / "weights.safetensors"
        )[0]
        for name, tensor in one.items():
            # forty Adam updates in float32, with sums in another order
            np.testing.assert_allclose(two[name], tensor, rtol=1e-3, atol=1e-4)


def test_evaluation(plan: Plan, root: Path) -> None:
    for algorithm, proximities in (("lion", [0.0, 0.5, 1.0]), ("td3_bc", [np.nan])):
        folder = out(plan, root, f"evaluate/{algorithm}/bad-0.4/seed3")
        with np.load(folder / "returns.npz", allow_pickle=False) as arrays:
            np.testing.assert_array_equal(arrays["lambdas"], proximities)
            assert arrays["returns"].shape == (4, len(proximities), 2)
            assert arrays["distances"].shape == (4, len(proximities))
            means = arrays["returns"].mean(axis=-1)  # [S, proximities]
        with np.load(folder / "curves.npz", allow_pickle=False) as curves:
            if algorithm == "lion":
                assert curves["over_proximity/return/step"].tolist() == [0, 50, 100]
                np.testing.assert_array_equal(curves["over_proximity/return/value"], means[-1])
                one = "evaluation/return_at_proximity_0.50"
            else:
                one = "evaluation/return"
            steps = [2, 4, 6, 8] if algorithm == "lion" else [10, 20, 30, 40]
            assert curves[f"{one}/step"].tolist() == steps
            np.testing.assert_array_equal(curves[f"{one}/value"], means[:, len(proximities) // 2])


@pytest.mark.parametrize("seeds", [(0,), (3,)])
def test_evaluation_of_a_seed_alone(seeds: tuple[int], plan: Plan, root: Path) -> None:
    nodes = [n for n in plan if n.name == f"evaluate/td3_bc/bad-0.4/seed{seeds[0]}"]
    run(nodes, root, f"alone-{seeds[0]}")
    paths = [root / w / nodes[0].key / "returns.npz" for w in ("nodes", f"alone-{seeds[0]}")]
    first, again = (np.load(path, allow_pickle=False)["returns"] for path in paths)
    np.testing.assert_allclose(first, again, rtol=1e-4)  # float32 actions


def test_aggregation(plan: Plan, root: Path) -> None:
    summary = stored(out(plan, root, "aggregate/lion/bad-0.4") / "summary.json")
    assert (summary["dataset"], summary["algorithm"]) == ("bad-0.4", "lion")
    assert summary["seeds"] == [0, 3]
    assert [p["lambda"] for p in summary["points"]] == [0.0, 0.5, 1.0]
    per_seed, distances = [], []
    for seed in (0, 3):
        path = out(plan, root, f"evaluate/lion/bad-0.4/seed{seed}") / "returns.npz"
        with np.load(path, allow_pickle=False) as arrays:
            per_seed.append(arrays["returns"][-1, 1].mean())  # a tenth of 4 snapshots: one
            distances.append(arrays["distances"][-1, 1])
    point = summary["points"][1]
    assert point["policies"] == 2
    assert point["mean"] == pytest.approx(np.mean(per_seed))
    assert point["std"] == point["seed_std"] == pytest.approx(np.std(per_seed, ddof=1))
    low, high = sorted(per_seed)
    assert point["tenth_percentile"] == pytest.approx(low + 0.1 * (high - low))
    assert point["distance"] == pytest.approx(np.mean(distances))
    fixed = stored(out(plan, root, "aggregate/td3_bc/bad-0.4") / "summary.json")
    assert [p["lambda"] for p in fixed["points"]] == [None]


def test_a_pool_of_twenty_snapshots_takes_the_last_two_of_every_seed(
    plan: Plan, tmp_path: Path
) -> None:
    [node] = [n for n in plan if n.name == "aggregate/td3_bc/bad-0.4"]
    for number, source in enumerate(node.inputs.values()):
        folder = tmp_path / "nodes" / source.key
        folder.mkdir(parents=True)
        (folder / "datasets.json").write_text("[]")
        returns = np.arange(20.0).reshape(20, 1, 1).repeat(10, axis=2) + 100.0 * number
        np.savez(
            folder / "returns.npz",
            lambdas=[np.nan],
            returns=returns,
            distances=np.zeros((20, 1)),
            ended_at=[700] if number else [],
        )
    run([node], tmp_path, "again")
    summary = stored(tmp_path / "again" / node.key / "summary.json")
    assert summary["ended_at"] == {"3": 700}
    [point] = summary["points"]
    assert point["policies"] == 4
    assert point["mean"] == np.mean([18.0, 19.0, 118.0, 119.0])


def test_returns_that_are_not_finite_are_valid_json_and_noted(plan: Plan, tmp_path: Path) -> None:
    [node] = [n for n in plan if n.name == "aggregate/td3_bc/bad-0.4"]
    for number, source in enumerate(node.inputs.values()):
        folder = tmp_path / "nodes" / source.key
        folder.mkdir(parents=True)
        (folder / "datasets.json").write_text("[]")
        returns = np.zeros((20, 1, 10))
        if number:
            returns[-1, 0, :3] = np.nan
            returns[0] = np.inf  # not in the pool
        distances = np.zeros((20, 1))
        np.savez(
            folder / "returns.npz",
            lambdas=[np.nan], returns=returns, distances=distances, ended_at=[],
        )  # fmt: skip
    run([node], tmp_path, "made")
    for name in ("summary.json", "metrics.json"):
        text = (tmp_path / "made" / node.key / name).read_text()
        assert "NaN" not in text
        assert "Infinity" not in text
    summary = stored(tmp_path / "made" / node.key / "summary.json")
    assert summary["undefined"] == {"3": 3}
    [point] = summary["points"]
    assert (point["mean"], point["iqm"], point["policies"]) == (None, None, 4)


def test_damaged_inputs_are_named(plan: Plan, tmp_path: Path) -> None:
    [node] = [n for n in plan if n.name == "td3_bc/bad-0.4/seed0"]
    job = Job(node.key, node.name, dict(node.config), {"dataset": tmp_path}, tmp_path)
    with pytest.raises(DamagedFileError, match=r"no dataset in .*card\.json is missing") as caught:
        load_task(node.task)([job], TaskContext(tmp_path))
    assert caught.value.path == tmp_path / "dataset" / "card.json"
