"""Robots in the plan: the experts of their datasets, and the settings of their models."""

from pathlib import Path

import pytest

from components.data.sources.robots import RobotSpec
from components.environments.mujoco.specifications import simulator_version
from flows.configuration.settings import Settings, SettingsError, load_settings
from flows.pipeline.plan import Plan
from flows.pipeline.task import Job, TaskContext, load_task
from flows.planning.benchmark import benchmark_plan, data_plan
from flows.planning.experts import expert_plan
from flows.planning.studies import study_specifications


@pytest.fixture
def settings() -> Settings:
    general = load_settings(["profile=smoke", "algorithms=[bc]", "tuning.models=all"])
    robots = {
        "dataset": {name: RobotSpec(name, name) for name in ("swimmer", "hopper")},
        "datasets": ("swimmer", "hopper"),
    }
    return general.model_copy(update=robots)


def test_a_missing_expert_ends_in_one_sentence(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("components.data.sources.robots.SHIPPED", tmp_path)
    with pytest.raises(SettingsError, match=r"^swimmer: There is no expert in .*train_experts"):
        data_plan(settings)


@pytest.fixture
def planned(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Settings:
    monkeypatch.setattr(
        "components.data.sources.robots.RobotSpec.ingredients",
        property(lambda spec: {"expert": f"digest of {spec.robot}"}),
    )
    return settings


def test_the_expert_is_part_of_a_dataset_s_identity(
    planned: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {node.name: node.key for node in data_plan(planned)}
    monkeypatch.setattr(
        "components.data.sources.robots.RobotSpec.ingredients",
        property(lambda spec: {"expert": "another"}),
    )
    after = {node.name: node.key for node in data_plan(planned)}
    assert before.keys() == after.keys()
    assert all(before[name] != after[name] for name in before)


def test_policies_are_evaluated_on_the_robot_they_learned_from(planned: Settings) -> None:
    nodes = [node for node in benchmark_plan(planned) if node.component == "evaluation"]
    evaluated = {(n.tags["dataset"], n.config["environment"]) for n in nodes}
    assert evaluated == {("swimmer", "proximity/Swimmer-v0"), ("hopper", "proximity/Hopper-v0")}
    assert all(n.config["parameters"] == {"physics": "v3"} for n in nodes)
    assert {n.config["evaluation"]["discount"] for n in nodes} == {0.99}


def with_mujoco(version: str, patched: pytest.MonkeyPatch) -> None:
    patched.setattr("importlib.metadata.version", lambda package: version)
    simulator_version.cache_clear()  # read once per process


def test_the_simulator_is_part_of_the_keys_of_robots_alone(
    planned: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of their data, their evaluations and their experts, and so of all that follows."""
    industrial = load_settings(["profile=smoke", "datasets=[bad-0.4]", "algorithms=[bc]"])

    def plans() -> list[Plan]:
        return [benchmark_plan(planned), expert_plan(planned), benchmark_plan(industrial)]

    with_mujoco("3.9.0", monkeypatch)
    before = plans()
    with_mujoco("3.10.0", monkeypatch)
    after = plans()
    for old, new, renewed in zip(before, after, (True, True, False), strict=True):
        assert len(old) == len(new)
        assert [one.key != two.key for one, two in zip(old, new, strict=True)] == (
            [renewed] * len(old)
        )
    named = {node.component for plan in after for node in plan if "simulator" in node.config}
    assert named == {"data_generation", "evaluation", "expert_training", "expert_choice"}
    assert all("simulator" not in node.config for node in after[2])


def test_the_discount_of_an_expert_s_card_is_part_of_its_choice_alone() -> None:
    before, after = (
        expert_plan(load_settings(["profile=smoke", f"experts.discount={discount}"]))
        for discount in (0.99, 0.9)
    )
    changed = {a.component for a, b in zip(before, after, strict=True) if a.key != b.key}
    assert changed == {"expert_choice"}


def test_another_simulator_than_the_planned_one_is_refused(
    planned: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a computer of a cluster where another version is installed."""
    with_mujoco("3.9.0", monkeypatch)
    nodes = {
        n.component: n for plan in (benchmark_plan(planned), expert_plan(planned)) for n in plan
    }
    monkeypatch.setattr(
        "flows.tasks.evaluation.read_input", lambda *read: pytest.fail("it was not refused first")
    )
    with_mujoco("4.0.0", monkeypatch)
    for component in ("data_generation", "evaluation", "expert_training"):
        node = nodes[component]
        job = Job(node.key, node.name, node.config, {}, tmp_path)
        with pytest.raises(
            ValueError, match=r"was planned with mujoco 3\.9\.0 on .*, but .* mujoco 4\.0\.0"
        ) as said:
            load_task(node.task)([job], TaskContext(tmp_path))
        assert "\n" not in str(said.value)


def test_robots_of_different_shapes_are_no_lanes_of_one_stack(planned: Settings) -> None:
    runner = planned.runner.model_copy(update={"pack": "algorithm"})
    plan = benchmark_plan(planned.model_copy(update={"runner": runner}))
    lanes: dict[str, set[str]] = {}
    for node in plan:
        if node.component == "policy_training":
            lanes.setdefault(node.lanes, set()).add(node.tags["dataset"])
    assert sorted(lanes.values(), key=str) == [{"hopper"}, {"swimmer"}]


def test_the_history_of_models_is_not_searched_where_one_frame_is_the_state(
    planned: Settings,
) -> None:
    for specification in study_specifications(planned):
        assert specification.space.keys() & {"history", "warm_up"} == set()
        assert "hidden" in specification.space
