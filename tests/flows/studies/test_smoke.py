"""Every kind of study on the smoke profile: small real runs that share one store."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from components.data.dataset import OfflineDataset
from flows import study
from flows.command_line import run_door
from flows.configuration.settings import SettingsError, load_settings
from flows.pipeline.errors import PipelineError
from flows.planning.online import online_plan
from flows.studies import STUDIES

RUNS = {
    "figure-2.3": ["seeds=[0]", "experts.training.steps=90"],
    "figure-2.4": ["datasets=[bad-0.4]"],
    "figure-6.9": [
        "datasets=[bad-0.4]",
        "variants.lion.eta=[0,0.1]",
        "variants.lion.beta=[0.1,1]",
    ],
    "figure-6.10": ["datasets=[bad-0.4]", "variants.lion.beta=[0.1,1]"],
    "figure-6.11": ["datasets=[bad-0.4]"],
    "figure-6.12": ["datasets=[bad-0.4]"],
    "caution": ["datasets=[bad-0.4]", "evaluation.proximity_step=1"],
    "pace": ["datasets=[bad-0.4]"],
    "table-6.1": ["datasets=[bad-0.4]", "mopo_penalties=[0,2.5]"],
}
COMMON = ["profile=smoke", "runner.executor=serial", "runner.tracker=none", "seeds=[0]"]
ONES_OWN = {"figure-6.1", "figure-6.5", "figure-6.8", "autopilot", "dials", "world"}
"""Parts of those above, and those that have tests of their own."""


def test_every_study_is_run() -> None:
    assert {*RUNS, *ONES_OWN} == set(STUDIES)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store")


def run(monkeypatch: pytest.MonkeyPatch, store: Path, name: str) -> int:
    """The exit code of a study."""
    words = list(dict.fromkeys([*COMMON, *RUNS[name]]))
    monkeypatch.setattr(sys, "argv", ["study", name, *words, f"store={store}", f"sweep={name}"])
    with pytest.raises(SystemExit) as ended:
        run_door("study", study.HELP, study._load, study._run)
    return int(ended.value.code or 0)


@pytest.mark.slow(8)
@pytest.mark.parametrize("name", RUNS)
def test_a_study_runs_and_given_again_only_draws(
    name: str, store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, store, name) == 0
    report = store / "reports" / name
    table = pd.read_csv(report / f"{name}.csv")
    assert len(table) >= 1
    assert table.select_dtypes("number").notna().any().any()
    text = (report / f"{name}.md").read_text(encoding="utf-8")
    assert "thesis" in text
    assert text in capsys.readouterr().out
    figures = {*report.glob("*[0-9].png"), *report.glob("*-eta.png"), *report.glob(f"{name}.png")}
    assert figures
    for figure in figures:
        with Image.open(figure) as drawn:
            assert min(drawn.size) > 200

    def refuse(*_: object) -> None:
        raise PipelineError("something was computed again")

    monkeypatch.setattr("flows.pipeline.executors.serial.run_group", refuse)
    before = (report / f"{name}.csv").read_bytes()
    (report / f"{name}.csv").unlink()
    assert run(monkeypatch, store, name) == 0
    assert (report / f"{name}.csv").read_bytes() == before


def test_words_of_a_reduced_budget_give_way_to_a_profile() -> None:
    known = STUDIES["table-6.1"]
    assert "algorithm.mopo.updates=300" in known.words([])
    paper = known.words(["profile=paper"])
    assert not any(word.startswith("algorithm.mopo") for word in paper)
    assert "seeds=[0]" not in paper
    assert "mopo_penalties=sweep" in paper
    assert load_settings(paper).algorithm["rvs"].hidden == (1024, 1024)


def test_an_offline_choice_needs_no_system() -> None:
    known = STUDIES["figure-6.9"]
    plan = known.plan(load_settings(known.words([])))
    assert set(plan.by_component()) == {
        "data_generation",
        "data_split",
        "model_fitting",
        "policy_training",
    }
    training = {node.inputs["dataset"].component for node in plan.by_component()["model_fitting"]}
    assert training == {"data_split"}, "models must not see the episodes that tell"


def test_only_robots_learn_online() -> None:
    known = STUDIES["figure-2.3"]
    with pytest.raises(SettingsError, match=r"bad-0\.4 is no robot"):
        known.plan(load_settings(known.words(["datasets=[bad-0.4]"])))


def test_the_offline_learner_is_the_online_one() -> None:
    settings = load_settings(STUDIES["figure-2.3"].words([]))
    nodes = online_plan(settings).by_component()
    training = settings.experts.training
    for policy in nodes["policy_training"]:
        own = policy.config["settings"]
        assert own["updates"] == training.steps - training.random_steps
        for name in ("learning_rate", "batch", "discount", "target_rate"):
            assert own[name] == getattr(training, name)
        assert tuple(own["hidden"]) == training.hidden
    counted = nodes["evaluation"][0].config["evaluation"]
    assert (counted["horizon"], counted["discount"]) == (training.horizon, 1.0)
    assert len(nodes["expert_training"]) == len(settings.seeds)
    # an expert that keeps nothing is another node: stored ones stay what they are
    assert all(node.config["keeps_transitions"] for node in nodes["expert_training"])


@pytest.mark.slow(1)
def test_the_replayed_log_is_what_happened_online(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "figure-2.3"
    assert run(monkeypatch, store, name) == 0
    words = list(dict.fromkeys([*COMMON, *RUNS[name]]))
    plan = online_plan(load_settings(STUDIES[name].words(words)))
    [log] = (n for n in plan if n.component == "online_log" and n.config["log"] == "replay")
    logged = OfflineDataset.open(store / "nodes" / log.key / "dataset")
    rows = np.load(store / "nodes" / log.inputs["online"].key / "transitions.npy")
    assert logged.transitions == len(rows) == 90
    width = logged.frames.shape[1]
    np.testing.assert_array_equal(logged.frames[logged.frame_rows()], rows[:, :width])
    np.testing.assert_array_equal(logged.rewards, rows[:, -width - 2])
    assert np.diff(logged.episode_starts).tolist() == [20, 20, 20, 20, 10]  # the time limit
