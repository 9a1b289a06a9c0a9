"""Settings: the documented defaults are the code's, and everything wrong ends in one sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from components.algorithms import ALGORITHMS
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.world import WorldSpec
from components.models import MODELS
from flows.command_line import make_executor
from flows.configuration.defaults import ALGORITHM_CONFIGS
from flows.configuration.files import CONF, names_in
from flows.configuration.settings import Settings, SettingsError, load_settings
from flows.pipeline.executors.ray import RayExecutor

ROOT = Path(__file__).parents[3]
THESIS_ROBOTS = ("hopper", "swimmer", "walker2d")
THESIS_DATASETS = (
    *(f"{name}-0.{n}" for name in ("bad", "mediocre", "optimized") for n in (0, 2, 4, 6, 8)),
    *("mediocre-1.0", *THESIS_ROBOTS),
)
ALL_DATASETS = ", ".join(names_in(CONF / "dataset"))


@pytest.fixture(scope="module")
def paper() -> Settings:
    return load_settings([])


@pytest.mark.parametrize("name", ALGORITHM_CONFIGS)
def test_defaults_of_algorithms_are_their_dataclasses_(name: str, paper: Settings) -> None:
    default = ALGORITHM_CONFIGS[name]()
    assert paper.algorithm[name] == default
    assert type(paper.algorithm[name]) is type(default)


@pytest.mark.parametrize("name", MODELS)
def test_defaults_of_models_are_their_dataclasses_(name: str, paper: Settings) -> None:
    assert paper.model[name] == MODELS[name].config()
    assert type(paper.model[name]) is MODELS[name].config


def test_the_registries_say_which_algorithms_and_models_there_are(paper: Settings) -> None:
    assert list(paper.algorithm) == sorted(ALGORITHMS)
    assert list(paper.model) == sorted(MODELS)
    assert load_settings(["algorithms=all"]).algorithms == tuple(sorted(ALGORITHMS))


def test_every_file_is_a_dataset_and_the_benchmark_is_all_but_the_sanity_check(
    paper: Settings,
) -> None:
    files = names_in(CONF / "dataset")
    assert list(paper.datasets) == sorted(paper.dataset) == sorted(THESIS_DATASETS)
    assert sorted({*paper.datasets, "world"}) == files
    assert load_settings(["datasets=[world]"]).dataset["world"] == WorldSpec("world")


def test_nineteen_datasets_are_those_of_the_thesis(paper: Settings) -> None:
    assert len(THESIS_DATASETS) == 19
    for name in THESIS_DATASETS:
        source = paper.dataset[name]
        if name in THESIS_ROBOTS:
            assert source == RobotSpec(name, name)
        else:
            controller, epsilon = name.split("-")
            assert source == IndustrialSpec(name, controller, float(epsilon))


def test_paper_is_the_default_profile_with_the_protocol_of_the_thesis(paper: Settings) -> None:
    assert paper.profile_name == "paper"
    updates = {
        **dict.fromkeys(("bc", "ddpg", "bcq", "bear", "brac", "td3_bc"), 10_000),
        **{"cql": 300_000, "mopo": 100_000, "morel": 500},
        **{"moose": 1000, "wsbc": 100, "lion": 1000},
    }
    assert set(paper.algorithms) == set(updates)
    # Comparisons and the control without regularisation are there to be chosen.
    assert set(ALGORITHMS) > set(updates)
    assert {name: paper.algorithm[name].updates for name in updates} == updates
    assert paper.seeds == (0, 1, 2, 3, 4)
    assert paper.training.snapshots == 20
    assert (paper.evaluation.trajectories, paper.evaluation.horizon) == (10, 100)
    assert paper.evaluation.proximity_step == 0.05
    assert paper.aggregation.pool_fraction == 0.1
    assert paper.store == Path("mlruns")
    assert not paper.dry_run


def test_quick_is_four_datasets_and_two_seeds_with_smaller_budgets(paper: Settings) -> None:
    quick = load_settings(["profile=quick"])
    assert (len(quick.datasets), len(quick.algorithms), len(quick.seeds)) == (4, 4, 2)
    for name in ALGORITHMS:  # those that the profile does not name have 2000 at most
        most = max(2000, paper.algorithm[name].updates - 1)
        assert quick.algorithm[name].updates <= most
    assert quick.training.snapshots == 20


def test_command_line_wins_over_profile_and_selects() -> None:
    settings = load_settings(
        [
            "seeds=[7,3]",
            "algorithm.lion.hidden=[12,8]",
            "datasets=[optimized-0.6,bad-0.0]",
            "algorithms=lion",
            "data.steps=300",
            "profile=smoke",
        ]
    )
    assert settings.seeds == (7, 3)
    assert settings.algorithm["lion"].hidden == (12, 8)
    assert settings.datasets == ("optimized-0.6", "bad-0.0")
    assert settings.algorithms == ("lion",)
    assert settings.dataset["bad-0.0"].steps == 300
    assert settings.dataset["bad-0.0"].trajectories == 10
    assert settings.algorithm["lion"].updates == 8, "the profile's budget stays"


@pytest.mark.parametrize(
    ("word", "valid"),
    [
        # unknown keys
        ("foo=1", "Unknown key 'foo'; valid keys: aggregation, algorithm, .* training"),
        ("algoritms=[lion]", "Did you mean 'algorithms'"),
        ("data.foo=1", "Unknown key 'data.foo'; valid keys in data: seed, steps, trajectories"),
        ("algorithm.lion.bta=1", "valid keys in algorithm.lion: .* Did you mean 'beta'"),
        ("algorithm.foo.updates=3", "valid keys in algorithm: bc, bcq, bear, brac"),
        (
            "model.foo.hidden=3",
            "valid keys in model: action_vae, behaviour_policy, .*recurrent_ensemble",
        ),
        ("evaluation.gamma=0.5", "valid keys in evaluation: discount, horizon, proximity_step"),
        ("dataset.bad-0.2.epsilon=2", r"edit its files, or select with datasets=\[...\]"),
        # unknown names
        ("profile=fast", "Unknown profile 'fast'; valid ones are chapter4, paper, quick, smoke"),
        ("profile=", "valid ones are chapter4, paper, quick, smoke"),
        (
            "datasets=[mediocre-0.3]",
            f"Unknown dataset 'mediocre-0.3'; valid ones are {ALL_DATASETS}",
        ),
        ("datasets=[]", f"selects nothing; valid ones are {ALL_DATASETS}"),
        ("datasets=null", f"valid ones are {ALL_DATASETS}"),
        ("datasets=[bad-0.0,bad-0.0]", "names one twice"),
        ("algorithms=[lyon]", "valid ones are bc, .*td3_bc, .*or all. Did you mean 'lion'"),
        ("algorithms=[]", "valid ones are bc, bcq, bear"),
        ("algorithms=[LION]", "or all. Did you mean 'lion'"),
        ("datasets=[bad-0.5]", "or all. Of this kind there are bad-0.0, bad-0.2, .*, bad-0.8.$"),
        ("datasets=[Bad-0.4]", "Did you mean 'bad-0.4'"),
        ("datasets=[größe,2026]", "Unknown dataset 'größe'"),
        # values
        ("seeds=[]", "must be a list of different whole numbers"),
        ("seeds=[0,0]", "must be a list of different whole numbers"),
        ("seeds=[-1]", "whole numbers from 0"),
        ("seeds=[0.5]", "whole numbers from 0"),
        ("seeds=[true]", "seeds=true: .* not be a boolean"),
        ("seeds=two", "whole numbers from 0"),
        ("data.seed=-1", "data.seed=-1: .* greater than or equal to 0"),
        ("data.steps=x", "data.steps='x': .* integer"),
        ("data.steps=true", "data.steps=true: .* not be a boolean"),
        ("data.trajectories=1", "greater than or equal to 2"),
        ("training.snapshots=3.5", "valid integer"),
        ("training.snapshots=2000", "raise the updates or lower the snapshots"),
        ("evaluation.proximity_step=0.3", "evaluation: proximity_step must divide 1"),
        ("evaluation.lambda_step=0.3", "evaluation: proximity_step must divide 1"),
        ("evaluation.lambda_step=0.001", "evaluation: .* at least 0.01, got 0.001"),
        ("evaluation.horizon=0", "evaluation: trajectories and horizon must be at least 1"),
        ("evaluation.horizon=x", "evaluation.horizon='x': .* integer"),
        ("aggregation.pool_fraction=2", "less than or equal to 1"),
        ("runner.executor=dask", "should be 'ray' or 'serial'"),
        ("runner.tracker=paper", "should be 'mlflow', 'file'"),
        ("runner.device=tpu", "'auto', 'cpu' or 'cuda'"),
        ("runner.cpus=0", "greater than or equal to 1"),
        ("runner.gpu_share=0", "greater than 0"),
        ("runner.precision=low", "'highest', 'high' or 'medium'"),
        ("algorithm.lion.updates=0", "algorithm.lion: updates, .* at least 1"),
        ("algorithm.lion.discount=1.5", r"discount must lie in \(0, 1\]"),
        (
            "algorithm.lion.hidden=256",
            r"hidden=256 must be a list; write algorithm.lion.hidden=\[256\]",
        ),
        ("algorithm.lion.hidden=[true]", "algorithm.lion.hidden=true: .* not be a boolean"),
        ("algorithm.lion.learning_rate=nan", "algorithm.lion.learning_rate=nan: .* finite"),
        ("algorithm.td3_bc.alpha=inf", "algorithm.td3_bc.alpha=inf: .* finite"),
        ("algorithm.td3_bc.alpha=1e39", "alpha=1e\\+39 is too large; the largest number is 3.4e"),
        ("data.seed=9223372036854775808", "is too large; the largest number is 2.63 - 1"),
        ("model.recurrent_ensemble.updates=0", "updates must be at least 1"),
        ("models=best", "models.source='best': Input should be 'default' or 'tuned'"),
        ("models=[lion]", "models.source=.*: Input should be 'default' or 'tuned'"),
        ("models.per_seed=3", "models.per_seed=3: Input should be a valid boolean"),
        ("models.per_sed=true", "Did you mean 'per_seed'"),
        ("runner.cpus=true", "runner.cpus=true: .* not be a boolean"),
        ("tuning.trials=0", "tuning.trials=0: .* greater than or equal to 1"),
        ("tuning.models=[lion]", "Unknown model 'lion'; valid ones are action_vae"),
        ("mopo_penalties=all", "must be null, sweep or a list of different numbers"),
        ("mopo_penalties=[]", "must be null, sweep or a list of different numbers"),
        ("mopo_penalties=[1,1.0]", "must be null, sweep or a list of different numbers"),
        ("mopo_penalties=[true]", "mopo_penalties=true: .* not be a boolean"),
        ("mopo_penalties=[nan]", r"mopo_penalties=\[nan\] must hold finite numbers from 0"),
        ("mopo_penalties=[inf]", r"mopo_penalties=\[inf\] must hold finite numbers from 0"),
        ("mopo_penalties=[-1]", r"mopo_penalties=\[-1\] must hold finite numbers from 0"),
        ("sweep=../up", "sweep='../up' names a folder and must be at most 100 letters"),
        (f"sweep={'x' * 101}", f"sweep='{'x' * 40}...' names a folder and must be"),
        ("sweep=a\nb", r"sweep='a.nb' names a folder"),
        ("sweep=", "sweep='' names a folder"),
        ("store=", "store= is empty; name a folder"),
        ("store=${nope}", "nope"),
        ("store=~nobody-of-this-name/runs", "store: there is no such home folder"),
        ("dry_run=maybe", "boolean"),
        # shape
        ("lion", "'lion' is not an override; write key=value"),
        ("dry_run", "'dry_run' has no value; write dry_run=true"),
        ("--dry-run", "written without dashes; write dry_run=true"),
        ("--profile=quick", "written without dashes; write profile=quick"),
        ("--profile", "written without dashes; write profile=VALUE"),
        ("+foo=1", "is not an override; write key=value"),
        ("~datasets", "is not an override; write key=value"),
        ("seeds=0,1", r"lists values without brackets; write seeds=\[...\]"),
        ("seeds=[0", "cannot be read; write key=value with lists as"),
        ("seeds=[0,1,]", "without a comma at the end"),
        ("datasets=bad-0.0,bad-0.2", r"lists values without brackets; write datasets=\[...\]"),
        ("datasets=[[bad-0.0]]", "cannot be read; write key=value with lists as"),
        ("datasets=[bad-0.0", "cannot be read; write key=value with lists as"),
        ("data=3", "data=3 must be a group of keys, e.g. data.KEY=VALUE"),
        ("algorithm=1", "algorithm=1 must be a group of keys"),
        ("algorithm=[lion]", r"must be a group of keys.* Did you mean 'algorithms=\[lion\]'"),
        ("model=null", "model=null must be a group of keys"),
        ("algorithm.lion=1", "algorithm.lion=1 must be a group of keys"),
        ("experts.training=1", "experts.training=1 must be a group of keys"),
        ("domain=1", "domain=1 must be a group of keys"),
        ("domain.mujoco=1", "domain.mujoco=1 must be a group of keys"),
        ("dataset=1", "edit its files, or select with datasets=1"),
        ("dataset=[x]", r"edit its files, or select with datasets=\[x\]"),
        ("dataset={x:{log:y}}", "edit its files, or select with datasets="),
        # inside a group that is given as a whole
        ("data={foo:1}", "Unknown key 'data.foo'; valid keys there: seed, trajectories"),
        ("algorithm.lion={bta:1}", "Unknown key 'algorithm.lion.bta'; .*Did you mean 'beta'"),
        ("algorithm={lyon:{updates:3}}", "Unknown key 'algorithm.lyon'; .*Did you mean 'lion'"),
        ("domain.mujoco={algoritm:{}}", "Unknown key 'domain.mujoco.algoritm'; valid .* algorithm"),
        ("domain.mujoco.algorithm={lyon:{}}", "Unknown key 'domain.mujoco.algorithm.lyon'; valid"),
        ("domain.mujoco.model_for={lion:{net:{}}}", "'domain.mujoco.model_for.lion.net'"),
        ("domain.mujoco.algorithm.bc.updats=1", "valid keys .* batch, hidden, .*mean 'updates'"),
        ("domain.mujoco.algorithm.bc.updates=-1", "^domain.mujoco.algorithm.bc: updates, "),
        ("domain.mujoco.model_for={lyon:{}}", "'domain.mujoco.model_for.lyon'; .* lion"),
    ],
)
def test_what_is_wrong_ends_in_one_sentence(word: str, valid: str) -> None:
    with pytest.raises(SettingsError, match=valid) as caught:
        load_settings([word])
    message = str(caught.value)
    assert "\n" not in message
    assert message[-1] in ".?"


def test_short_keys_stand_for_long_ones(paper: Settings) -> None:
    assert (paper.models.source, paper.models.per_seed) == ("default", False)
    for word in ("models=tuned", "models.source=tuned"):
        assert load_settings([word]).models.source == "tuned"
    assert load_settings(["models.per_seed=true"]).models.per_seed is True
    aliases = {"models": "tuning.models", "trials": "tuning.trials"}
    found = load_settings(["models=[action_vae]", "trials=3"], aliases).tuning
    assert (found.models, found.trials) == (("action_vae",), 3)
    assert (paper.tuning.models, paper.tuning.trials) == (("recurrent_ensemble",), 30)
    assert set(load_settings(["models=all"], aliases).tuning.models) == set(MODELS)


def test_the_old_name_of_the_proximity_step_keeps_working(paper: Settings) -> None:
    for word in (
        "evaluation.lambda_step=0.1",
        "evaluation.proximity_step=0.1",
        "evaluation={lambda_step:0.1}",
    ):
        assert load_settings([word]).evaluation.proximity_step == 0.1
        assert load_settings([word]).evaluation.horizon == paper.evaluation.horizon


def test_penalties_are_checked_and_become_variants() -> None:
    words = ["algorithms=[mopo]", "mopo_penalties=[0,0.5]"]
    settings = load_settings(words)
    varied = settings.varied_on(settings.datasets[0], "mopo")
    assert [(key, value, config.penalty) for key, value, config in varied] == [
        ("penalty", 0.0, 0.0),
        ("penalty", 0.5, 0.5),
    ]


@pytest.mark.slow(4)
@pytest.mark.parametrize(
    ("word", "code", "says"),
    [
        ("foo=1", 2, "full_benchmark: Unknown key 'foo'; valid keys: "),
        ("data.steps=50", 2, "full_benchmark: data.steps=50 is less than warm_up + horizon = 80"),
        ("dry_run=true", 0, "13 of 13 nodes to do"),
        ("show_settings=true", 0, "recurrent_ensemble:\n    members: 2"),
    ],
)
def test_bad_input_dry_runs_and_shown_settings_leave_nothing_behind(
    word: str, code: int, says: str, tmp_path: Path
) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "flows.full_benchmark",
            "profile=smoke",
            "algorithms=[lion,td3_bc]",
            "store=left",
            word,
        ],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    shown, silent = (done.stderr, done.stdout) if code else (done.stdout, done.stderr)
    assert says in shown
    assert silent == ""
    assert list(tmp_path.iterdir()) == []
    if code:
        assert len(shown.splitlines()) == 1


def test_settings_are_varied_one_at_a_time() -> None:
    words = ["algorithms=[lion]", "variants.lion.eta=[0,1]", "variants.lion.aggregation=[mean]"]
    settings = load_settings(words)
    varied = settings.varied_on("world", "lion")
    assert [(key, value) for key, value, _ in varied] == [
        ("eta", 0), ("eta", 1), ("aggregation", "mean"),
    ]  # fmt: skip
    assert [(c.eta, c.aggregation) for *_, c in varied] == [
        (0.0, "minimum"), (1.0, "minimum"), (0.1, "mean"),
    ]  # fmt: skip
    assert type(varied[1][2].eta) is float, "1 and 1.0 have to be one key"
    assert settings.varied_on("world", "bc") == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["variants.lion.eta=0.1"], r"variants.lion.eta=0.1 must be a list of values, e.g. \["),
        (["variants.lion.eta=[]"], "must be a list of values"),
        (["variants.lion.eta=[-1]"], "variants.lion: .* eta not negative"),
        (["variants.lion.etta=[1]"], "Unknown key 'variants.lion.etta'.* Did you mean 'eta'?"),
        (["variants.lino.eta=[1]"], "Unknown key 'variants.lino'.* Did you mean 'lion'?"),
        (["algorithms=[bc]", "variants.lion.eta=[1]"], "lion is not among the algorithms; add it"),
    ],
)
def test_what_cannot_be_varied_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        load_settings(["algorithms=[lion]", *words] if len(words) == 1 else words)


def test_penalties_without_their_algorithm_are_refused() -> None:
    with pytest.raises(SettingsError, match="mopo is not among the algorithms; add it"):
        load_settings(["mopo_penalties=[0,1]", "algorithms=[lion]"])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["seeds=[0]", "seeds=[1]"], r"'seeds=\[0\]' and 'seeds=\[1\]' .* give seeds once"),
        (["profile=smoke", "profile=quick"], "profile=smoke and profile=quick contradict"),
        (["data={seed:1}", "data.seed=2"], "give data.seed once"),
        (["models=tuned", "models.source=default"], "give models.source once"),
    ],
)
def test_contradicting_words_are_refused(words: list[str], says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        load_settings(words)


def test_what_is_given_twice_alike_is_given_once() -> None:
    words = ["seeds=[3]", "data={seed:1}", "data.steps=90", "profile=smoke"]
    settings = load_settings([*words, *words, "algorithms=[bc]"])
    assert (settings.seeds, settings.data.seed, settings.data.steps) == ((3,), 1, 90)


def test_a_setting_of_a_domain_is_checked_where_no_dataset_of_it_is_chosen() -> None:
    words = ["datasets=[bad-0.4]", "domain.mujoco.algorithm.bc.batch=0"]
    with pytest.raises(SettingsError, match=r"^domain\.mujoco\.algorithm\.bc: .* at least 1"):
        load_settings(words)
    found = load_settings(["datasets=[hopper]", "domain.mujoco.algorithm.bc.batch=3"])
    assert found.algorithm_on("hopper", "bc").batch == 3


def test_a_task_s_share_of_a_gpu_reaches_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    executor = make_executor(load_settings(["runner.gpu_share=0.1"]))
    assert isinstance(executor, RayExecutor)
    assert (executor.device, executor._gpus) == ("cuda", 0.1)


@pytest.mark.parametrize("kind", ["ray", "serial"])
@pytest.mark.parametrize(
    ("words", "found"), [([], "high"), (["runner.precision=highest"], "highest")]
)
def test_precision_reaches_the_executor(kind: str, words: list[str], found: str) -> None:
    settings = load_settings([f"runner.executor={kind}", "runner.device=cpu", *words])
    assert make_executor(settings).precision == found
