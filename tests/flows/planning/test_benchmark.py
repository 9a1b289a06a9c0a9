"""The plan: keys follow what decides a result, and nothing else."""

import functools
from dataclasses import replace

import pytest

from components.algorithms import ALGORITHMS
from components.data.sizes import DataSizes
from components.models import MODELS
from flows.configuration.checking import SettingsError
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node, Plan
from flows.planning import nodes
from flows.planning.benchmark import benchmark_plan, data_plan, model_choice, sweep_name
from tests.flows.grid import overridden

BASE = (
    "profile=smoke", "datasets=[mediocre-0.2,bad-0.4]", "algorithms=[lion,td3_bc]", "seeds=[0,1]",
)  # fmt: skip
COMPONENTS = [
    "data_generation", "model_fitting", "policy_training", "evaluation", "aggregation",
]  # fmt: skip
EVERY_KIND = {
    "data", "behaviour_policy", "recurrent_ensemble", "lion", "td3_bc",
    "evaluate/lion", "evaluate/td3_bc", "aggregate/lion", "aggregate/td3_bc",
}  # fmt: skip


@functools.cache  # reading settings takes half a second; a plan is never changed
def plan(*words: str) -> Plan:
    return benchmark_plan(load_settings(overridden(BASE, words)))


def keys(made: Plan) -> dict[str, str]:
    return {node.name: node.key for node in made}


def kind(name: str) -> str:
    parts = name.split("/")
    return "/".join(parts[:2]) if parts[0] in ("evaluate", "aggregate") else parts[0]


def node(made: Plan, name: str) -> Node:
    [found] = [node for node in made if node.name == name]
    return found


def test_every_component_has_its_nodes() -> None:
    made = plan()
    counts = made.counts()
    assert [counts[name] for name in COMPONENTS] == [2, 4, 8, 8, 4]
    assert {kind(name) for name in keys(made)} == EVERY_KIND
    assert len({n.name for n in made}) == len(made)


@pytest.mark.parametrize(
    "word",
    [
        "runner.executor=serial",
        "runner.cpus=1",
        "runner.threads=2",
        "runner.device=cpu",
        "runner.gpu_share=0.1",
        "pack=algorithm",
        "store=elsewhere",
        "sweep=named",
        "dry_run=true",
    ],
)
def test_how_it_runs_changes_no_key(word: str) -> None:
    assert keys(plan(word)) == keys(plan())


AFTER_LION = {"lion", "evaluate/lion", "aggregate/lion"}
AFTER_TD3_BC = {"td3_bc", "evaluate/td3_bc", "aggregate/td3_bc"}
EVALUATED = {"evaluate/lion", "evaluate/td3_bc", "aggregate/lion", "aggregate/td3_bc"}


@pytest.mark.parametrize(
    ("word", "changed"),
    [
        ("data.seed=1", EVERY_KIND),
        ("data.trajectories=11", EVERY_KIND),
        ("data.steps=201", EVERY_KIND),
        ("model.recurrent_ensemble.hidden=9", {"recurrent_ensemble"} | AFTER_LION),
        ("model.recurrent_ensemble.updates=21", {"recurrent_ensemble"} | AFTER_LION),
        ("model.recurrent_ensemble.learning_rate=0.004", {"recurrent_ensemble"} | AFTER_LION),
        # the distance to the behaviour policy is measured for every algorithm
        ("model.behaviour_policy.epochs=3", {"behaviour_policy"} | AFTER_LION | EVALUATED),
        ("algorithm.lion.eta=0.2", AFTER_LION),
        ("algorithm.lion.updates=9", AFTER_LION),
        ("algorithm.lion.hidden=[17]", AFTER_LION),
        ("algorithm.td3_bc.alpha=2.6", AFTER_TD3_BC),
        ("algorithm.td3_bc.discount=0.9", AFTER_TD3_BC),
        ("training.snapshots=5", AFTER_LION | AFTER_TD3_BC),
        ("evaluation.trajectories=3", EVALUATED),
        ("evaluation.horizon=21", EVALUATED),
        ("evaluation.lambda_step=0.25", EVALUATED),
        ("aggregation.pool_fraction=0.2", {"aggregate/lion", "aggregate/td3_bc"}),
    ],
)
def test_what_matters_changes_the_keys_of_all_that_follows(word: str, changed: set[str]) -> None:
    before, after = keys(plan()), keys(plan(word))
    assert before.keys() == after.keys()
    assert {kind(name) for name in before if before[name] != after[name]} == changed
    assert {kind(name) for name in before if before[name] == after[name]} == EVERY_KIND - changed


def test_a_new_version_of_an_algorithm_renews_its_runs_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    raised = replace(ALGORITHMS["lion"], version=ALGORITHMS["lion"].version + 1)
    before = keys(plan())
    monkeypatch.setattr(nodes, "ALGORITHMS", {**ALGORITHMS, "lion": raised})
    after = keys(benchmark_plan(load_settings(BASE)))
    assert {kind(name) for name in before if before[name] != after[name]} == AFTER_LION
    assert {kind(name) for name in before if before[name] == after[name]} == EVERY_KIND - AFTER_LION


@pytest.mark.parametrize(
    ("model", "changed"),
    [
        ("recurrent_ensemble", {"recurrent_ensemble"} | AFTER_LION),
        ("gaussian_ensemble", set()),  # no policy of this plan reads it
    ],
)
def test_a_new_version_of_a_model_renews_its_fits_and_what_reads_them(
    model: str, changed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    raised = replace(MODELS[model], version=MODELS[model].version + 1)
    before = keys(plan())
    monkeypatch.setattr(nodes, "MODELS", {**MODELS, model: raised})
    after = keys(benchmark_plan(load_settings(BASE)))
    assert {kind(name) for name in before if before[name] != after[name]} == changed


STORED = {
    "behaviour_policy": "a436436badb5f6c8b1408e2e54b8512a",
    "gaussian_behaviour": "07e38a4f0ebfe03344443682c9702459",
    "recurrent_ensemble": "1ce92bb8e2f81aff2b5a8f01f7570a37",
    "deterministic_ensemble": "5836b4b8f7c24fffdac87bf28dee75a8",
    "gaussian_ensemble": "68fd54b8c89e371422c39cd0cebcc019",
    "residual_ensemble": "f017172ad549852fe7dec2dfdff76ed8",
    "action_vae": "566bef104a2835bf9ee9f8a4923e59a2",
}
"""Keys of fits with default settings, under which users have stored them."""


def test_fits_of_unchanged_models_keep_the_keys_under_which_they_are_stored() -> None:
    # Rightly fails for a kind whose defaults or version change, and only then; so does its line.
    data = Node("data_generation", "data/log", "tasks:generate", 2, {"seed": 0})
    found = {
        n: nodes.model_node(n, MODELS[n].config(), "log", data, DataSizes()).key for n in STORED
    }
    assert found == STORED


def test_every_run_is_judged_on_random_numbers_of_its_own() -> None:
    judged = plan().by_component()["evaluation"]
    streams = [tuple(n.config["stream"]) for n in judged]
    assert streams == [
        (n.tags["dataset"], n.tags["algorithm"], int(n.tags["seed"])) for n in judged
    ]
    assert len(set(streams)) == len(judged) == 8


def test_more_seeds_keep_the_old_runs_and_renew_the_pool_only() -> None:
    before, after = keys(plan()), keys(plan("seeds=[0,1,2]"))
    differing = {kind(name) for name in before if before[name] != after[name]}
    assert differing == {"aggregate/lion", "aggregate/td3_bc"}


def test_selection_of_others_changes_no_key() -> None:
    whole = keys(plan())
    for word in ("datasets=[bad-0.4]", "algorithms=[lion]"):
        part = keys(plan(word))
        assert part.items() <= whole.items()
        assert len(part) < len(whole)


def test_seeds_of_a_pair_are_lanes_of_one_program() -> None:
    made = plan()
    lanes = {n.name: n.lanes for n in made if n.lanes}
    assert lanes["lion/bad-0.4/seed0"] == lanes["lion/bad-0.4/seed1"]
    assert lanes["evaluate/lion/bad-0.4/seed0"] == lanes["evaluate/lion/bad-0.4/seed1"]
    # two algorithms on two datasets, trained and evaluated
    assert len(set(lanes.values())) == 8
    assert len(lanes) == 16


def test_datasets_of_an_algorithm_can_be_lanes_too() -> None:
    made = plan("pack=algorithm")
    training = {n.lanes for n in made if n.component == "policy_training"}
    assert len(training) == 2


def test_a_program_can_have_a_number_of_datasets() -> None:
    three = "datasets=[bad-0.4,mediocre-0.2,optimized-0.6]"
    made = plan(three, "pack=2")
    lanes = {n.name: n.lanes for n in made if n.component == "policy_training"}
    assert lanes["lion/bad-0.4/seed0"] == lanes["lion/mediocre-0.2/seed1"]
    assert lanes["lion/bad-0.4/seed0"] != lanes["lion/optimized-0.6/seed0"]
    assert len(set(lanes.values())) == 4  # two algorithms, each in two programs
    assert keys(made) == keys(plan(three))


@pytest.mark.parametrize("pack", ["0", "2.5", "pairs"])
def test_a_program_of_no_datasets_is_refused(pack: str) -> None:
    with pytest.raises(SettingsError, match=r"must be auto, .* or a number of datasets"):
        plan(f"pack={pack}")


def lanes_of(made: Plan, component: str) -> list[set[str]]:
    """Names of the nodes that are computed together."""
    together: dict[str, set[str]] = {}
    for n in made:
        if n.component == component:
            together.setdefault(n.lanes, set()).add(n.name)
    return sorted(together.values(), key=min)


def test_every_policy_can_be_trained_and_evaluated_by_itself() -> None:
    made = plan("pack=none")
    assert len(lanes_of(made, "policy_training")) == made.counts()["policy_training"]
    assert len(lanes_of(made, "evaluation")) == made.counts()["evaluation"]
    assert keys(made) == keys(plan())


def test_the_device_chooses_what_is_trained_together(monkeypatch: pytest.MonkeyPatch) -> None:
    components = ("policy_training", "evaluation")

    def packs(*words: str) -> list[list[set[str]]]:
        made = benchmark_plan(load_settings(overridden(BASE, words)))
        return [lanes_of(made, component) for component in components]

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert packs() == packs("pack=pair")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert packs() == packs("pack=algorithm")
    assert packs("runner.device=cpu") == packs("pack=pair")


def test_the_old_word_for_packing_is_understood() -> None:
    assert load_settings([*BASE, "runner.stack=algorithm"]).runner.pack == "algorithm"


def test_algorithms_and_seeds_share_the_models() -> None:
    made = plan()
    for seed in (0, 1):
        lion = node(made, f"lion/bad-0.4/seed{seed}").inputs
        assert set(lion) == {"dataset", "behaviour_policy", "recurrent_ensemble"}
        assert lion["recurrent_ensemble"].key == node(made, "recurrent_ensemble/bad-0.4").key
        td3_bc = node(made, f"td3_bc/bad-0.4/seed{seed}").inputs
        assert set(td3_bc) == {"dataset"}
        assert lion["dataset"].key == td3_bc["dataset"].key
        evaluated = node(made, f"evaluate/td3_bc/bad-0.4/seed{seed}").inputs
        assert evaluated["behaviour_policy"].key == lion["behaviour_policy"].key


def fits(made: Plan) -> dict[tuple[str, str], list[str]]:
    found: dict[tuple[str, str], list[str]] = {}
    for n in made:
        if n.component == "model_fitting":
            found.setdefault((n.tags["model"], n.tags["dataset"]), []).append(n.key)
    return found


def test_policies_of_a_seed_can_have_models_of_their_own() -> None:
    shared, own = plan(), plan("models.per_seed=true")
    # seed 1 gets a second fit of both models of both datasets
    assert [own.counts()[name] for name in COMPONENTS] == [2, 8, 8, 8, 4]
    assert all(len(keys) == 2 for keys in fits(own).values())
    for pair, [key] in fits(shared).items():
        assert fits(own)[pair].count(key) == 1, "seed 0 of a policy uses seed 0 of its models"
    for seed in (0, 1):
        policy = node(own, f"lion/bad-0.4/seed{seed}")
        for role in ("behaviour_policy", "recurrent_ensemble"):
            config = policy.inputs[role].config
            assert config["seed"] == seed
            assert config | {"seed": 0} == node(shared, f"{role}/bad-0.4").config
        # distances are measured to one behaviour policy, whatever the policy was trained with
        reference = node(own, f"evaluate/lion/bad-0.4/seed{seed}").inputs["behaviour_policy"]
        assert reference.key == node(shared, "behaviour_policy/bad-0.4").key
    before, after = keys(shared), keys(own)
    assert before["lion/bad-0.4/seed0"] == after["lion/bad-0.4/seed0"]
    assert before["lion/bad-0.4/seed1"] != after["lion/bad-0.4/seed1"]
    assert before["td3_bc/bad-0.4/seed1"] == after["td3_bc/bad-0.4/seed1"]
    # still lanes of one program
    lanes = {n.lanes for n in own if n.name.startswith("lion/bad-0.4/")}
    assert len(lanes) == 1


def test_models_of_other_shapes_are_no_lanes_of_one_stack() -> None:
    settings = load_settings([*BASE, "pack=algorithm"])
    choice = model_choice(settings)
    pair = ("bad-0.4", "recurrent_ensemble")
    wider = replace(choice.configs[pair], hidden=9)
    made = benchmark_plan(settings, replace(choice, configs={**choice.configs, pair: wider}))
    lanes = {n.name: n.lanes for n in made if n.component == "policy_training"}
    assert lanes["lion/bad-0.4/seed0"] != lanes["lion/mediocre-0.2/seed0"]
    assert lanes["td3_bc/bad-0.4/seed0"] == lanes["td3_bc/mediocre-0.2/seed0"]


def test_one_policy_per_penalty() -> None:
    base = ("algorithms=[mopo]", "seeds=[0,1]", "datasets=[bad-0.4]")
    one, swept = plan(*base), plan(*base, "mopo_penalties=[0,1,2.5]")
    assert [one.counts()[name] for name in COMPONENTS] == [1, 2, 2, 2, 1]
    assert [swept.counts()[name] for name in COMPONENTS] == [1, 2, 6, 6, 3]
    policy = node(swept, "mopo-penalty-2.5/bad-0.4/seed1")
    assert policy.config["settings"]["penalty"] == 2.5
    assert policy.tags == {
        "dataset": "bad-0.4", "algorithm": "mopo", "seed": "1", "penalty": "2.5",
    }  # fmt: skip
    # the default among them is the very policy that an ordinary sweep trains
    default = one.by_component()["policy_training"][0]
    assert default.config["settings"]["penalty"] == 1.0
    assert keys(swept)["mopo-penalty-1/bad-0.4/seed0"] == keys(one)["mopo/bad-0.4/seed0"]
    evaluated = "evaluate/mopo-penalty-1/bad-0.4/seed0"
    assert keys(swept)[evaluated] == keys(one)["evaluate/mopo/bad-0.4/seed0"]
    summary = node(swept, "aggregate/mopo-penalty-0/bad-0.4")
    assert summary.config["algorithm"] == "mopo-penalty-0"
    assert summary.tags == {"dataset": "bad-0.4", "algorithm": "mopo", "penalty": "0"}
    for component in ("policy_training", "evaluation"):
        assert len({n.lanes for n in swept if n.component == component}) == 3
    whole = plan(*base, "mopo_penalties=sweep")
    trained = whole.by_component()["policy_training"]
    chosen = sorted({n.config["settings"]["penalty"] for n in trained})
    assert chosen == [k / 10 for k in range(26)]


def test_variants_of_any_setting_with_the_models_they_need() -> None:
    words = ("variants.lion.transition=[recurrent_ensemble,deterministic_ensemble]",)
    made = plan("algorithms=[lion]", "datasets=[bad-0.4]", *words, "variants.lion.beta=[0.1,1]")
    # the default Beta is the default transition: one configuration, under its first name
    labels = {n.config["algorithm"] for n in made if n.component == "aggregation"}
    assert labels == {
        "lion-transition-recurrent_ensemble",
        "lion-transition-deterministic_ensemble",
        "lion-beta-1",
    }
    policy = node(made, "lion-transition-deterministic_ensemble/bad-0.4/seed0")
    assert "deterministic_ensemble" in policy.inputs
    assert policy.tags["transition"] == "deterministic_ensemble"


def test_models_that_nothing_needs_are_not_fitted() -> None:
    names = keys(plan("algorithms=[td3_bc]"))
    assert {kind(name) for name in names} == EVERY_KIND - AFTER_LION - {"recurrent_ensemble"}


def test_tags_say_what_a_node_is() -> None:
    tags = node(plan(), "lion/bad-0.4/seed1").tags
    assert tags == {"dataset": "bad-0.4", "algorithm": "lion", "seed": "1"}


def test_the_discount_of_the_protocol_belongs_to_the_dataset() -> None:
    config = node(plan(), "evaluate/lion/bad-0.4/seed0").config
    assert config["evaluation"]["discount"] == 0.97
    assert config["parameters"] == {"setpoint": 70.0}


def test_names_of_sweeps() -> None:
    settings = load_settings([*BASE])
    name = sweep_name(settings, benchmark_plan(settings))
    assert name.startswith("smoke-")
    again = load_settings([*BASE, "runner.cpus=1", "store=other"])
    assert sweep_name(again, benchmark_plan(again)) == name
    other = load_settings([*BASE, "data.seed=1"])
    assert sweep_name(other, benchmark_plan(other)) != name
    named = load_settings([*BASE, "sweep=mine"])
    assert sweep_name(named, benchmark_plan(named)) == "mine"


def test_data_alone() -> None:
    made = data_plan(load_settings([*BASE]))
    assert made.counts() == {"data_generation": 2}
    assert keys(made).items() <= keys(plan()).items()
