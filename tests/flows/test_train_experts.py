"""The door that trains experts: its plan, its tasks, what it says, shows and installs."""

import json
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.data.controllers.trained import shipped
from components.data.controllers.trained.shipped import Expert
from components.data.sources.robots import RobotSpec
from components.experts import online
from components.experts.config import ExpertConfig
from components.policies.policy import Policy
from flows import train_experts
from flows.command_line import main
from flows.configuration.settings import SettingsError, load_settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.task import Job, TaskContext, load_task
from flows.planning.experts import expert_plan
from flows.train_experts import ALIASES
from tests.components.interruption import KilledError, dying

WORDS = ("profile=smoke", "runner.executor=serial")


def plan_of(*words: str) -> Plan:
    return expert_plan(load_settings([*WORDS, *words], ALIASES))


def jobs_of(nodes: Sequence[Node], root: Path) -> list[Job]:
    jobs = []
    for node in nodes:
        out = root / node.key
        out.mkdir(parents=True)
        inputs = {role: root / source.key for role, source in node.inputs.items()}
        config = json.loads(json.dumps(node.config))
        jobs.append(Job(node.key, node.name, config, inputs, out))
    return jobs


def run(nodes: Sequence[Node], root: Path) -> None:
    """One task call, as the pipeline makes it."""
    work = root / "work"
    work.mkdir(exist_ok=True, parents=True)
    load_task(nodes[0].task)(jobs_of(nodes, root), TaskContext(work))


def door(*words: str) -> int:
    """What a shell would see."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", ["train_experts", *WORDS, *words])
        patched.delenv("MLFLOW_TRACKING_URI", raising=False)
        with pytest.raises(SystemExit) as ended:
            main("train_experts", train_experts.HELP, train_experts._run, ALIASES)
    return ended.value.code  # type: ignore[return-value]


def test_seeds_of_a_robot_are_lanes_and_one_of_them_is_chosen() -> None:
    plan = plan_of("robots=all", "seeds=[3,1]")
    assert plan.counts() == {"expert_training": 6, "expert_choice": 3}
    for node in plan:
        if node.component == "expert_training":
            assert node.lanes == f"expert/{node.tags['robot']}"
        else:
            trained = {role: source.tags for role, source in node.inputs.items()}
            robot = node.tags["robot"]
            assert trained == {f"seed{s}": {"robot": robot, "seed": str(s)} for s in (3, 1)}
            assert node.config["seeds"] == [1, 3]


@pytest.mark.slow(2)
@pytest.mark.parametrize("method", ["ddpg", "td3"])
def test_an_expert_says_how_it_was_trained(method: str, tmp_path: Path) -> None:
    *seeds, choice = plan_of(f"experts.training.method={method}")
    run(seeds, tmp_path)
    run([choice], tmp_path)
    expert = Expert.load(tmp_path / choice.key / "expert")
    assert expert.policy.card.algorithm == method
    assert expert.card.training.get("method", "ddpg") == method


@pytest.mark.slow(3)
def test_a_training_is_known_by_its_own_settings_alone() -> None:
    def keys(*words: str) -> set[str]:
        return {n.key for n in plan_of(*words) if n.component == "expert_training"}

    first = keys("seeds=[0,1]")
    assert first < keys("seeds=[0,1,2]", "robots=all")
    assert first == keys("seeds=[0,1]", "experts.episodes=7", "install=true", "runner.threads=2")
    for word in ("steps=90", "physics=v5", "experts.training.exploration=0.2"):
        assert not first & keys("seeds=[0,1]", word)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("robots=[walker]", "Unknown robot 'walker'; valid ones are swimmer, hopper, walker2d"),
        ("robots=[]", "selects nothing"),
        ("seeds=[0,0]", "different whole numbers"),
        ("physics=v4", "experts.physics='v4': Input should be 'v3' or 'v5'"),
        ("steps=20", "experts.training: random_steps is 30; give a number from 1 to steps=20"),
        ("steps=ten", "experts.training.steps='ten': .* integer"),
        ("experts.training.depth=3", "valid keys in experts.training: batch, discount"),
        ("install=perhaps", "boolean"),
        ("experts=3", "experts=3 must be a group of keys"),
    ],
)
def test_what_is_wrong_ends_in_one_sentence(word: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message) as caught:
        plan_of(word)
    assert "\n" not in str(caught.value)


def test_documented_defaults_are_the_code_s() -> None:
    experts = load_settings([]).experts
    assert experts.training == ExpertConfig()
    assert experts.robots == ("swimmer", "hopper", "walker2d")
    assert (experts.seeds, experts.physics, experts.episodes) == ((0, 1, 2, 3), "v3", 100)
    assert experts.discount == RobotSpec("swimmer", "swimmer").discount
    assert not experts.install


def test_the_seed_with_the_best_evaluation_is_evaluated_again(tmp_path: Path) -> None:
    plan = plan_of("experts.training.discount=0.9", "experts.discount=0.95")
    *seeds, choice = plan
    run(seeds, tmp_path)
    reached = []
    for node in seeds:
        with np.load(tmp_path / node.key / "curves.npz", allow_pickle=False) as curves:
            assert curves["evaluation/return/step"].tolist() == [30, 60]
            reached.append(curves["evaluation/return/value"].max())
    run([choice], tmp_path)
    expert = Expert.load(tmp_path / choice.key / "expert")
    card = expert.card
    assert card.seed == int(np.argmax(reached))
    assert card.candidates == {"0": reached[0], "1": reached[1]}
    own = Policy.load(tmp_path / seeds[card.seed].key / "policy")
    assert own.card.steps == (card.step,)
    for (one, _), (two, _) in zip(own.layers, expert.policy.layers, strict=True):
        assert one.equal(two)
    assert (card.training["steps"], card.episodes, card.return_steps) == (60, 2, 20)
    assert (card.training["discount"], card.discount) == (0.9, 0.95)
    assert card.environment == "proximity/Swimmer-v0"
    assert card.return_mean != card.candidates[str(card.seed)]
    metrics = json.loads((tmp_path / choice.key / "metrics.json").read_text())
    assert metrics["return_mean"] == card.return_mean


def test_a_seed_without_a_finite_return_is_not_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    *seeds, choice = plan_of()
    run(seeds, tmp_path)

    def reach(*returns: float) -> None:
        found = [{"return": value, "step": 30} for value in returns]
        monkeypatch.setattr("flows.tasks.experts.load_json", lambda path: found.pop(0))

    reach(float("nan"), -5.0)
    run([choice], tmp_path)
    assert Expert.load(tmp_path / choice.key / "expert").card.seed == 1
    reach(float("nan"), float("-inf"))
    with pytest.raises(ValueError, match="No seed of swimmer has reached a finite return"):
        load_task(choice.task)(jobs_of([choice], tmp_path / "again"), TaskContext(tmp_path))


@pytest.mark.slow(2)
def test_a_killed_training_is_continued_in_its_work_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = [node for node in plan_of() if node.component == "expert_training"]
    run(seeds, tmp_path / "whole")
    update = online.OnlineLearner.update
    monkeypatch.setattr(online.OnlineLearner, "update", dying(update, 41))
    with pytest.raises(KilledError):
        run(seeds, tmp_path / "killed")
    monkeypatch.setattr(online.OnlineLearner, "update", update)
    for node in seeds:
        (tmp_path / "killed" / node.key).rmdir()
    run(seeds, tmp_path / "killed")
    for node in seeds:
        weights = [
            (tmp_path / where / node.key / "policy" / "weights.safetensors").read_bytes()
            for where in ("whole", "killed")
        ]
        assert weights[0] == weights[1]


@pytest.mark.slow(4)
def test_the_door_trains_records_and_installs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "shipped"
    place.mkdir()
    monkeypatch.setattr(train_experts, "SHIPPED", place)
    store = f"store={tmp_path / 'mlruns'}"
    assert door(store, "dry_run=true") == 0
    assert not (tmp_path / "mlruns").exists()
    assert "expert training" in capsys.readouterr().out
    assert door(store) == 0
    table = capsys.readouterr().out.splitlines()
    assert table[0].split()[:4] == ["expert", "seed", "step", "return"]
    assert table[1].split()[0] == "swimmer"
    assert list(place.iterdir()) == []

    trained = sorted((tmp_path / "mlruns" / "nodes").glob("[!.]*"))
    assert door(store, "install=true") == 0
    assert sorted((tmp_path / "mlruns" / "nodes").glob("[!.]*")) == trained  # all reused
    expert = Expert.load(place / "swimmer")
    monkeypatch.setattr("components.data.sources.robots.SHIPPED", place)
    dataset = RobotSpec("swimmer", "swimmer", transitions=30, steps=20).generate(0)
    assert dataset.card.controller_digest == expert.card.digest

    with sqlite3.connect(tmp_path / "mlruns" / "mlflow.db") as database:
        names = {n for (n,) in database.execute("select name from runs")}
        sweeps = dict(
            database.execute(
                "select key, value from params where run_uuid in "
                "(select run_uuid from tags where key = 'role' and value = 'sweep')"
            )
        )
    assert {"expert/swimmer/seed0", "expert/swimmer/seed1", "expert/swimmer"} < names
    assert (sweeps["robots"], sweeps["seeds"]) == ("swimmer", "0,1")


def test_experts_are_looked_for_beside_the_code() -> None:
    assert Path(shipped.__file__).parent == shipped.SHIPPED == train_experts.SHIPPED


def test_help_names_every_short_key() -> None:
    shown: Any = train_experts.HELP
    assert all(f"  {word}=" in shown for word in ALIASES)
