"""Datasets without a system: their plans and their sweeps end with a judgement from the log."""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from components.algorithms import ALGORITHMS
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.policies.policy import Policy
from flows import full_benchmark
from flows.configuration import composition, files, schema
from flows.configuration.settings import Settings, SettingsError, load_settings
from flows.pipeline.plan import Plan
from flows.planning.benchmark import benchmark_plan, data_plan
from tests.components.synthetic import make_log
from tests.flows.grid import finished, overridden

pytestmark = pytest.mark.slow(1)

LOG = make_log()
WORDS = ("profile=smoke", "datasets=[my-log]", "seeds=[0,1]", "training.snapshots=2")


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A project folder whose conf/ names a log of its own."""
    shutil.copytree(composition.CONF, tmp_path / "conf")
    for module in (composition, files, schema):
        monkeypatch.setattr(module, "CONF", tmp_path / "conf")
    named = tmp_path / "conf" / "dataset" / "my-log.yaml"
    named.write_text("my-log:\n  log: logs/mine\n", encoding="utf-8")
    LOG.write(tmp_path / "logs" / "mine")
    composition.base_layers.cache_clear()
    yield tmp_path
    composition.base_layers.cache_clear()


def chosen(*words: str) -> Settings:
    return load_settings(overridden(WORDS, words))


def replaced(project: Path, log: OfflineDataset) -> None:
    shutil.rmtree(project / "logs" / "mine")
    log.write(project / "logs" / "mine")


def data_key(plan: Plan) -> str:
    [node] = [node for node in plan if node.component == "data_generation"]
    return node.key


def test_plans_end_with_judgements(project: Path) -> None:
    plan = benchmark_plan(chosen("algorithms=[bc,td3_bc]"))
    # Episodes of 40 steps are too short for an ensemble: a behaviour policy is all that is fitted.
    assert plan.counts() == {
        "data_generation": 1,
        "data_split": 2,
        "policy_training": 4,
        "model_fitting": 1,
        "judgement": 4,
    }
    assert {node.name for node in plan if not plan.dependents(node.key)} == {
        f"judge/{name}/my-log/seed{seed}" for name in ("bc", "td3_bc") for seed in (0, 1)
    }
    for node in plan.by_component()["judgement"]:
        learned, judging = node.inputs["policy"].inputs["dataset"], node.inputs["dataset"]
        assert (learned.config["part"], judging.config["part"]) == ("train", "judge")
    both = benchmark_plan(chosen("algorithms=[bc]", "datasets=[my-log,bad-0.0]"))
    evaluated = {node.tags["dataset"] for node in both if node.component == "evaluation"}
    assert evaluated == {"bad-0.0"}


@pytest.mark.parametrize("word", ["judging.policies=none", "datasets=[my-log]"])
def test_plans_end_at_the_policies_where_nothing_is_judged(project: Path, word: str) -> None:
    if word.startswith("datasets"):
        replaced(project, make_log(episodes=3))  # too few for two parts
    plan = benchmark_plan(chosen("algorithms=[bc]", word))
    assert plan.counts() == {"data_generation": 1, "policy_training": 2}


def test_the_judges_of_a_system_know_an_ensemble_and_are_asked_for() -> None:
    words = ("profile=smoke", "algorithms=[bc,lion]", "seeds=[0]")
    assert "judgement" not in benchmark_plan(load_settings(words)).counts()
    plan = benchmark_plan(load_settings([*words, "judging.policies=all"]))
    assert plan.counts()["judgement"] == plan.counts()["evaluation"] == 2
    bc, lion = plan.by_component()["judgement"]
    assert set(lion.inputs) - set(bc.inputs) == {"trained_in"}
    own, judges = lion.inputs["trained_in"], lion.inputs["recurrent_ensemble"]
    assert own.config["settings"] == judges.config["settings"]
    assert own.config["seed"] != judges.config["seed"]
    assert own.inputs["dataset"].config["part"] == "train"
    assert judges.inputs["dataset"].config["part"] == "judge"


def test_the_key_holds_the_content_of_a_log_but_not_its_folder_or_the_data_seed(
    project: Path,
) -> None:
    before = data_key(data_plan(chosen()))
    assert data_key(data_plan(chosen("data.seed=5"))) == before
    (project / "logs" / "mine").rename(project / "elsewhere")
    named = project / "conf" / "dataset" / "my-log.yaml"
    named.write_text(f"my-log:\n  log: {project / 'elsewhere'}\n", encoding="utf-8")
    composition.base_layers.cache_clear()
    assert data_key(data_plan(chosen())) == before
    (project / "elsewhere" / "card.json").unlink()
    shutil.rmtree(project / "elsewhere")
    dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, discount=0.5)).write(
        project / "elsewhere"
    )
    assert data_key(data_plan(chosen())) != before


def test_a_version_for_falls_counts_where_the_card_says_that_the_system_can_fall(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def planned() -> list[int]:
        plan = benchmark_plan(chosen("algorithms=[mopo]", "datasets=[my-log,bad-0.0]", "seeds=[0]"))
        policies = plan.by_component()["policy_training"]
        return [node.config["algorithm_version"] for node in policies]

    mopo = ALGORITHMS["mopo"]
    assert planned() == [mopo.version] * 2
    healthy = {**LOG.card.dynamics, "healthy": {"fatigue": [0.0, 9.0]}}
    replaced(
        project, dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, dynamics=healthy))
    )
    assert planned() == [mopo.version_with_falls, mopo.version]
    assert mopo.version_with_falls != mopo.version
    assert ALGORITHMS["td3_bc"].version_on(healthy) == ALGORITHMS["td3_bc"].version


def test_the_log_is_stored_like_any_dataset_and_learned_from(project: Path) -> None:
    plan = benchmark_plan(chosen("algorithms=[bc]", "seeds=[0]"))
    store = finished(plan, project / "store")
    for node in plan:
        folder = store.path(node.key)
        if node.component == "data_split":
            part = OfflineDataset.open(folder / "dataset")
            episodes = {"train": slice(0, 4), "judge": slice(4, 6)}[node.config["part"]]
            rows = np.r_[tuple(slice(n * 40, n * 40 + 40) for n in range(6)[episodes])]
            np.testing.assert_array_equal(part.actions, LOG.actions[rows])
        elif node.component == "judgement":
            with np.load(folder / "judgement.npz") as found:
                assert np.isfinite(found["fitted_q"]).all()
        elif node.component == "data_generation":
            made = OfflineDataset.open(folder / "dataset")
            assert made.card == dataclasses.replace(LOG.card, name="my-log")
            np.testing.assert_array_equal(made.actions, LOG.actions)
            described = json.loads((folder / "node.json").read_text(encoding="utf-8"))
            assert str(project) not in json.dumps(described["config"])
        else:
            policies = sorted(path.parent for path in folder.rglob("policy.json"))
            assert policies
            assert Policy.load(policies[0]).card.history == LOG.card.history


def test_policies_from_a_log_of_a_registered_system_are_evaluated_there(project: Path) -> None:
    generated = IndustrialSpec("mine", "mediocre", 0.5, trajectories=4, steps=110).generate(0)
    replaced(project, generated)
    plan = benchmark_plan(chosen("algorithms=[bc]", "seeds=[0]"))
    [evaluation] = [node for node in plan if node.component == "evaluation"]
    assert evaluation.config["environment"] == generated.card.environment
    assert evaluation.config["parameters"] == {"setpoint": 70.0}
    store = finished(plan, project / "store")
    assert np.isfinite(np.load(store.path(evaluation.key) / "returns.npz")["returns"]).all()


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("auto", "judged from its log alone."),
        ("none", "stored but neither evaluated nor judged, since judging.policies=none."),
    ],
)
def test_the_door_succeeds_and_says_that_policies_are_not_evaluated(
    project: Path, capsys: pytest.CaptureFixture[str], wanted: str, said: str
) -> None:
    words = ("algorithms=[bc]", "runner.executor=serial", f"store={project / 'store'}")
    assert full_benchmark._run(chosen(*words, f"judging.policies={wanted}")) == 0
    note = f"my-log has no system to evaluate on: its policies are {said}"
    shown = capsys.readouterr().out
    assert f"Note: {note}" in shown
    [report] = (project / "store" / "reports").glob("*/results.md")
    assert f"- {note}" in report.read_text(encoding="utf-8")
    [*table] = report.parent.glob("selection.csv")
    assert bool(table) == ("best first by" in shown) == (wanted == "auto")
    if table:
        row = pd.read_csv(table[0]).iloc[0]
        assert (row["dataset"], row["algorithm"], row["policies"]) == ("my-log", "bc", 2)
        assert np.isfinite(row["score"])


def test_a_log_of_too_few_episodes_is_said_to_be_so(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replaced(project, make_log(episodes=3))
    words = ("algorithms=[bc]", "runner.executor=serial", f"store={project / 'store'}")
    assert full_benchmark._run(chosen(*words)) == 0
    said = "a judgement from the log takes 4 episodes, and it has 3."
    assert f"its policies are stored but not evaluated; {said}" in capsys.readouterr().out


def test_a_path_that_leads_nowhere_ends_in_one_sentence(project: Path) -> None:
    shutil.rmtree(project / "logs" / "mine")
    with pytest.raises(SettingsError, match=r"^my-log: There is no dataset in .*my-log\.yaml\.$"):
        benchmark_plan(chosen("algorithms=[bc]"))
    assert benchmark_plan(chosen("algorithms=[bc]", "datasets=[bad-0.0]")).counts()["evaluation"]


def test_a_damaged_log_ends_in_one_sentence(project: Path) -> None:
    (project / "logs" / "mine" / "rewards.npy").unlink()
    with pytest.raises(SettingsError, match=r"^my-log: .*rewards\.npy is missing.*\.yaml\.$"):
        benchmark_plan(chosen("algorithms=[bc]"))


def test_a_mistyped_system_on_the_card_is_refused(project: Path) -> None:
    card = dataclasses.replace(LOG.card, environment="proximity/IndustrialBenchmark-v1")
    replaced(project, dataclasses.replace(LOG, card=card))
    with pytest.raises(SettingsError, match=r"^my-log: .*Benchmark-v1'; registered are .* none\.$"):
        benchmark_plan(chosen("algorithms=[bc]"))


@pytest.mark.parametrize("word", ["", "none", None])
def test_a_card_may_say_that_there_is_no_system(project: Path, word: Any) -> None:
    card = dataclasses.replace(LOG.card, environment=word)
    replaced(project, dataclasses.replace(LOG, card=card))
    assert "evaluation" not in benchmark_plan(chosen("algorithms=[bc]")).counts()


def test_a_log_of_a_single_episode_is_refused(project: Path) -> None:
    replaced(project, make_log(episodes=1))
    with pytest.raises(SettingsError, match=r"^my-log has a single episode, and models hold one"):
        benchmark_plan(chosen("algorithms=[bc]"))


def test_model_based_learners_need_the_card_to_tell_the_dynamics(project: Path) -> None:
    bare = dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, dynamics={}))
    replaced(project, bare)
    assert benchmark_plan(chosen("algorithms=[bc]")).counts()["policy_training"] == 2
    with pytest.raises(
        SettingsError,
        match=r"^my-log: .* lacks 'known' in its dynamics specification .*no transition model\.$",
    ):
        benchmark_plan(chosen("algorithms=[bc,lion]"))


def test_model_based_learners_need_episodes_as_long_as_a_window(project: Path) -> None:
    words = ("algorithms=[lion]", "model.recurrent_ensemble.horizon=500")
    with pytest.raises(SettingsError, match=r"^my-log has 40 steps an episode, .* warm_up"):
        benchmark_plan(chosen(*words))


@pytest.mark.parametrize(
    ("line", "message"),
    [("log: 3", r"dataset\.my-log\.log=3"), ("log: logs/mine\n  epsilon: 0.1", "epsilon")],
)
def test_wrong_files_of_logs_are_refused(project: Path, line: str, message: str) -> None:
    named = project / "conf" / "dataset" / "my-log.yaml"
    named.write_text(f"my-log:\n  {line}\n", encoding="utf-8")
    composition.base_layers.cache_clear()
    with pytest.raises(SettingsError, match=message):
        chosen()
