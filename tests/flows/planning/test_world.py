"""The 2-D world in the plan: its models, its settings, its sizes."""

import pytest

from components.data.sizes import DataSizes
from flows.configuration.settings import SettingsError, load_settings
from flows.pipeline.plan import Plan
from flows.planning.benchmark import benchmark_plan
from flows.planning.costs import data_cost, data_sizes
from flows.planning.memory import least_bytes


def planned(*words: str) -> Plan:
    return benchmark_plan(load_settings([*words, "seeds=[0]"]))


def test_its_lion_learns_in_memoryless_models_and_others_in_recurrent_ones() -> None:
    plan = planned("datasets=[world,bad-0.4]", "algorithms=[lion,model_based]")
    lion = {n.tags["dataset"]: n for n in plan if n.name.startswith("lion/")}
    assert set(lion["world"].inputs) == {"dataset", "behaviour_policy", "deterministic_ensemble"}
    assert set(lion["bad-0.4"].inputs) == {"dataset", "behaviour_policy", "recurrent_ensemble"}
    assert lion["world"].config["settings"]["return_scale"] == 101.0
    assert lion["world"].config["settings"]["transition"] == "deterministic_ensemble"
    assert not {"return_scale", "transition"} & lion["bad-0.4"].config["settings"].keys()
    fitted = lion["world"].inputs["deterministic_ensemble"].config["settings"]
    assert (fitted["hidden"], fitted["target"]) == ([32, 24], "value")


def test_a_model_that_no_algorithm_chooses_is_not_asked_to_suit() -> None:
    names = {node.name for node in planned("datasets=[world]", "algorithms=[bc,lion]")}
    assert "recurrent_ensemble/world" not in names


def test_a_recurrent_ensemble_needs_longer_episodes() -> None:
    with pytest.raises(SettingsError, match="world has 25 steps an episode, which is less than"):
        planned(
            "datasets=[world]", "algorithms=[model_based]", "model.recurrent_ensemble.horizon=50"
        )


def test_unknown_transition_models_are_refused() -> None:
    with pytest.raises(SettingsError, match="transition must be one of recurrent_ensemble, det"):
        planned("datasets=[world]", "algorithms=[lion]", "algorithm.lion.transition=gaussian")
    with pytest.raises(SettingsError, match="return_scale must be positive"):
        planned("datasets=[world]", "algorithms=[lion]", "algorithm.lion.return_scale=-1")


def test_sizes() -> None:
    plan = planned("datasets=[world]", "algorithms=[bc]")
    [data] = plan.by_component()["data_generation"]
    source = load_settings(["datasets=[world]"]).dataset["world"]
    assert data_sizes(source) == DataSizes(1, 2, 2, 10_000)
    assert least_bytes([data]) == 10_000 * (2 + 2 + 1) * 4
    assert 0 < data_cost(source) < 1
