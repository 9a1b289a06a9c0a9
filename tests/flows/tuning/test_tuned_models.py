"""A real search by its door, on tiny data, and benchmark runs that use what it found."""

import re
import shutil
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from components.data.dataset import OfflineDataset
from components.models import MODELS
from flows import full_benchmark, tune_models
from flows.command_line import main
from flows.configuration.settings import ALIASES, Settings, SettingsError, load_settings
from flows.pipeline.json_lines import read_lines
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_views import saved_views
from flows.planning.benchmark import benchmark_plan, model_choice
from flows.planning.studies import study_specifications
from flows.tuning.file_trials import FileTrials
from flows.tuning.journal import open_journal
from flows.tuning.mlflow_trials import MlflowTrials
from flows.tuning.study import Study
from tests.flows.grid import overridden
from tests.flows.tuning.toys import run as search_toy
from tests.flows.tuning.toys import study as toy_study

pytestmark = pytest.mark.slow(1)

WORDS = (
    "profile=smoke", "datasets=[mediocre-0.2]", "data.trajectories=4", "data.steps=100",
    "runner.executor=serial",
)  # fmt: skip
CHOSEN = ["behaviour_policy", "recurrent_ensemble"]
TRIALS = 4


def door(module: Any, words: Sequence[str], aliases: dict[str, str]) -> int:
    """What a shell would see."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", ["door", *words])
        patched.delenv("MLFLOW_TRACKING_URI", raising=False)
        with pytest.raises(SystemExit) as ended:
            main("door", module.HELP, module._run, aliases)
    return ended.value.code  # type: ignore[return-value]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tuned")
    words = [*WORDS, f"models=[{','.join(CHOSEN)}]", f"trials={TRIALS}"]
    words += [f"store={folder}/mlruns", f"models.folder={folder}/conf"]
    assert door(tune_models, words, tune_models.ALIASES) == 0
    return folder


def words_of(home: Path) -> list[str]:
    return [*WORDS, f"store={home}/mlruns", f"models.folder={home}/conf"]


def settings_of(home: Path, *words: str) -> Settings:
    usual = [*words_of(home), "algorithms=[lion]", "models=tuned"]
    return load_settings(overridden(usual, words))


def studies_of(home: Path) -> dict[str, Study]:
    words = [*words_of(home), f"models=[{','.join(CHOSEN)}]"]
    settings = load_settings(words, tune_models.ALIASES)
    journal = open_journal(home / "mlruns" / "optuna" / "journal.log")
    return {s.model: Study(s, journal) for s in study_specifications(settings)}


def fits(settings: Settings) -> dict[str, Node]:
    plan = benchmark_plan(settings)
    return {n.tags["model"]: n for n in plan if n.component == "model_fitting"}


@pytest.mark.parametrize("model", CHOSEN)
def test_the_file_says_what_was_found(model: str, home: Path) -> None:
    study, store = studies_of(home)[model], ArtifactStore(home / "mlruns")
    assert study.ended == TRIALS
    best, start = study.best(), study.start_trial()
    path = home / "conf" / "mediocre-0.2" / f"{model}.yaml"
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert (found["dataset"], found["model"]) == ("mediocre-0.2", model)
    assert (found["study"], found["trial"], found["trials"]) == (study.name, best.number, TRIALS)
    assert found["validation_loss"] == best.value <= found["default_validation_loss"]
    assert found["default_validation_loss"] == start.value
    data = study.specification.data
    assert found["data_key"] == data.key
    dataset = OfflineDataset.open(store.path(data.key) / "dataset")
    assert found["data_digest"] == dataset.card.digest
    kind = MODELS[model].config
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in found["settings"].items()}
    assert kind(**settings) == study.config(best)
    # the numbers of the study are those of the artifacts
    metrics = store.path(best.user_attrs["key"]) / "metrics.json"
    assert yaml.safe_load(metrics.read_text())["validation_loss"] == best.value


def test_the_first_trial_is_what_a_benchmark_without_tuning_fits(home: Path) -> None:
    default = fits(settings_of(home, "models=default"))
    for model, study in studies_of(home).items():
        assert study.start_trial().user_attrs["key"] == default[model].key


def test_studies_say_what_they_are_in_the_dashboard_and_have_a_view_in_mlflow(home: Path) -> None:
    pages = MlflowExperiment(home / "mlruns")
    parent = next(pages.search("tags.role = 'sweep' and tags.kind = 'search'"))
    views = saved_views(pages.entity().tags)
    for model, study in studies_of(home).items():
        assert study._study.metric_names == ["held-out loss"]
        # Where optuna-dashboard 0.21 looks.
        note = study._study._storage.get_study_system_attrs(study._study._study_id)
        text = note["dashboard:note_str:0"]
        assert (len(text) <= 2045, note["dashboard:note_ver"]) == (True, 1)
        assert f"the model **{model}** on the dataset **mediocre-0.2**" in text
        assert f"#/experiments/{pages.id}/runs/{parent.info.run_id}?" in text
        assert f"Trials of {model} on mediocre-0.2" in views.values()
        for run in pages.search(f"tags.study = '{study.name}'"):
            trial = study.trials()[int(run.data.tags["trial"])]
            history = pages.client.get_metric_history(
                run.info.run_id, "model/validation_loss_on_the_way"
            )
            assert {m.step: m.value for m in history} == trial.intermediate_values


@pytest.mark.slow(2)
def test_a_larger_search_says_how_far_it_is(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(home, tmp_path / "copy")
    words = [*words_of(tmp_path / "copy"), "models=[behaviour_policy]", f"trials={TRIALS + 1}"]
    assert door(tune_models, words, tune_models.ALIASES) == 0
    said = capsys.readouterr().err
    assert (
        f"mediocre-0.2 behaviour_policy: continuing: {TRIALS} of {TRIALS + 1} trials done" in said
    )


@pytest.mark.slow(2)
def test_a_benchmark_uses_the_winners_without_fitting_again(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = ArtifactStore(home / "mlruns")
    nodes = fits(settings_of(home))
    for model, study in studies_of(home).items():
        assert nodes[model].key == study.best().user_attrs["key"]
        assert store.complete(nodes[model].key)
    words = [*words_of(home), "algorithms=[moose]", "models=tuned", "dry_run=true"]
    assert door(full_benchmark, words, dict(ALIASES)) == 0
    assert capsys.readouterr().err.splitlines()[:2] == [
        "Models with tuned settings: mediocre-0.2/behaviour_policy.",
        "Models with default settings: mediocre-0.2/action_vae, "
        "mediocre-0.2/deterministic_ensemble.",
    ]


def test_models_without_a_file_keep_their_default(home: Path) -> None:
    settings = settings_of(home, "algorithms=[lion,moose]")
    choice = model_choice(settings)
    assert choice.tuned == {("mediocre-0.2", model) for model in CHOSEN}
    assert choice.configs["mediocre-0.2", "action_vae"] == settings.model["action_vae"]


@pytest.mark.slow(2)
def test_tuned_and_per_seed_go_together(home: Path) -> None:
    plan = benchmark_plan(settings_of(home, "models.per_seed=true", "seeds=[0,5]"))
    tuned = {model: node.config["settings"] for model, node in fits(settings_of(home)).items()}
    made = [n for n in plan if n.component == "model_fitting"]
    assert {(n.tags["model"], n.config["seed"]) for n in made} == {
        (model, seed) for model in CHOSEN for seed in (0, 5)
    }
    assert all(n.config["settings"] == tuned[n.tags["model"]] for n in made)


def test_every_trial_is_a_run_below_the_search(home: Path) -> None:
    experiment = MlflowTrials(home / "mlruns").experiment
    [parent] = experiment.search("tags.kind = 'search'")
    assert parent.info.status == "FINISHED"
    names = {f.path for f in experiment.client.list_artifacts(parent.info.run_id, "report")}
    assert names == {f"report/{model}.yaml" for model in CHOSEN}
    for model, study in studies_of(home).items():
        runs = list(experiment.search(f"tags.study = '{study.name}'"))
        assert {int(run.data.tags["trial"]) for run in runs} == set(range(TRIALS))
        assert len(runs) == TRIALS
        for run in runs:
            trial = study.trials()[int(run.data.tags["trial"])]
            assert run.data.tags["mlflow.parentRunId"] == parent.info.run_id
            assert (run.info.status, run.data.tags["state"]) == ("FINISHED", "COMPLETE")
            assert run.data.metrics["validation_loss"] == trial.value
            assert run.data.tags["key"] == trial.user_attrs["key"]
            assert run.info.run_name == f"{model}/mediocre-0.2/trial{trial.number}"
        lowest = experiment.client.get_metric_history(
            parent.info.run_id, f"best_loss/mediocre-0.2/{model}"
        )
        assert [m.step for m in lowest] == list(range(TRIALS))
        assert lowest[-1].value == study.best().value


@pytest.mark.slow(2)
def test_the_same_command_again_changes_nothing(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = home / "mlruns"
    before = {path.name for path in (store / "nodes").iterdir()}
    words = [*words_of(home), f"models=[{','.join(CHOSEN)}]", f"trials={TRIALS}"]
    assert door(tune_models, [*words, "dry_run=true"], tune_models.ALIASES) == 0
    for model, line in zip(CHOSEN, capsys.readouterr().out.splitlines(), strict=True):
        assert line.startswith(f"mediocre-0.2/{model}/")
        assert line.endswith(": 4 of 4 trials have ended")
    assert door(tune_models, words, tune_models.ALIASES) == 0
    assert "; the default has " in capsys.readouterr().out
    assert {path.name for path in (store / "nodes").iterdir()} == before
    assert studies_of(home)[CHOSEN[0]].ended == TRIALS
    with sqlite3.connect(store / "mlflow.db") as database:
        [(found,)] = database.execute("select count(*) from tags where key = 'trial'")
    assert found == len(CHOSEN) * TRIALS


@pytest.mark.parametrize(("kind", "lines"), [("file", 2 + TRIALS), ("none", 0)])
def test_a_search_needs_no_mlflow(
    kind: str, lines: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*WORDS, "models=[behaviour_policy]", f"trials={TRIALS}", "sweep=search"]
    words += [f"store={tmp_path}/mlruns", f"models.folder={tmp_path}/conf"]
    words += [f"runner.tracker={kind}"]
    for _ in range(2):  # again: nothing is added
        assert door(tune_models, words, tune_models.ALIASES) == 0
        assert "; the default has " in capsys.readouterr().out
        found = read_lines(tmp_path / "mlruns" / "tracking" / "search.jsonl")
        assert len(found) == lines
    assert not (tmp_path / "mlruns" / "mlflow.db").exists()
    if kind == "file":
        begun, *trials, ended = found
        assert begun["params"]["models"] == "behaviour_policy"
        assert [trial["number"] for trial in trials] == list(range(TRIALS))
        assert ended["files"] == [str(tmp_path / "conf" / "mediocre-0.2" / "behaviour_policy.yaml")]
        lowest = ended["metrics"]["best_loss/mediocre-0.2/behaviour_policy"]
        assert lowest[-1][1] == min(trial["loss"] for trial in trials)


def test_trials_of_every_kind_have_one_line(tmp_path: Path) -> None:
    log, place = tmp_path / "log", tmp_path / "mlruns"
    log.mkdir()
    (log / "fail-bad").touch()
    study = toy_study(place, log)
    study.recover()
    study._study.enqueue_trial({"x": 0.5, "mood": "bad"})
    (log / "interrupt").touch()
    for code in (130, 0, 0):
        trials = FileTrials(place)
        trials.open("first", {"kind": "search"}, {})
        assert search_toy(place, log, 4, tracker=trials).exit_code == code
        trials.close("FINISHED")
    ended = toy_study(place, log).trials()
    found = [
        event
        for event in read_lines(place / "tracking" / "first.jsonl")
        if event["event"] == "trial"
    ]
    assert sorted(event["number"] for event in found) == [trial.number for trial in ended]
    assert {event["study"] for event in found} == {study.name}
    assert {event["state"] for event in found} == {"COMPLETE", "FAIL", "INTERRUPTED"}
    for event in found:
        trial = ended[event["number"]]
        assert event["drawn"] == trial.params
        assert event["on_the_way"] == {str(k): v for k, v in trial.intermediate_values.items()}
        assert event["loss"] == (trial.value if event["state"] == "COMPLETE" else None)
        if event["state"] == "FAIL":
            assert event["reason"].startswith("ValueError: this toy is in a bad mood (")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("settings: [", "it is not YAML"),
        ("just text", "it holds no settings"),
        ({"trial": None}, "it must hold dataset, model, .* settings and nothing else, see 'trial'"),
        ({"model": "wsbc"}, "it is about wsbc on mediocre-0.2"),
        ({"data_key": "0" * 32}, "it was tuned on other data than these settings make"),
        ({"settings.hiden": [3]}, "Unknown key 'settings.hiden'; valid keys there: hidden"),
        ({"settings.epochs": None}, "settings lacks epochs"),
        ({"settings.epochs": 0}, "settings: epochs, batch and every hidden width must be"),
        ({"settings.batch": "many"}, "settings.batch='many': Input should be a valid integer"),
        ({"settings.batch": True}, "settings.batch=true: Input should not be a boolean"),
    ],
)
@pytest.mark.slow(1)
def test_a_wrong_file_is_named_with_its_remedy(
    change: Any, says: str, home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(home / "conf", tmp_path / "conf")
    path = tmp_path / "conf" / "mediocre-0.2" / "behaviour_policy.yaml"
    if isinstance(change, dict):
        content = yaml.safe_load(path.read_text())
        for place, value in change.items():
            *groups, name = place.split(".")
            group = content[groups[0]] if groups else content
            group.pop(name, None)
            group |= {} if value is None else {name: value}
        path.write_text(yaml.safe_dump(content))
    else:
        path.write_text(change)
    folder = f"models.folder={tmp_path}/conf"
    with pytest.raises(SettingsError, match=says) as caught:
        benchmark_plan(settings_of(home, folder))
    message = str(caught.value)
    assert message.startswith(f"{path} cannot be used (")
    assert message.endswith(
        "); make it again with 'python -m flows.tune_models datasets=[mediocre-0.2] "
        "models=[behaviour_policy]', or use models=default."
    )
    assert "\n" not in message
    words = overridden(words_of(home), ["algorithms=[lion]", "models=tuned", folder])
    assert door(full_benchmark, words, dict(ALIASES)) == 2
    assert message in capsys.readouterr().err


def test_other_data_is_not_what_was_tuned_on(home: Path) -> None:
    with pytest.raises(SettingsError, match="tuned on other data"):
        benchmark_plan(settings_of(home, "data.seed=1"))


@pytest.mark.slow(2)
def test_nothing_tuned_at_all_is_an_error(home: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no file for behaviour_policy, recurrent_ensemble on"):
        benchmark_plan(settings_of(home, f"models.folder={tmp_path}"))
    with pytest.raises(SettingsError, match=r"mediocre-0\.4; make them with 'python -m flows"):
        benchmark_plan(settings_of(home, "datasets=[mediocre-0.4]"))


def test_a_setting_that_a_tuned_file_would_override_is_refused(home: Path) -> None:
    word = "model.recurrent_ensemble.updates=30"
    with pytest.raises(SettingsError, match=f"'{word}' has no effect with models=tuned"):
        benchmark_plan(settings_of(home, word))
    free = settings_of(home, "algorithms=[moose]", "model.action_vae.epochs=3")
    assert fits(free)["action_vae"].config["settings"]["epochs"] == 3


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("models=[lion]", "Unknown model 'lion'; valid ones are action_vae, behaviour_policy"),
        ("models=tuned", "Unknown model 'tuned'"),
        ("models=[]", r"models=\[\] selects nothing"),
        ("trials=0", "tuning.trials=0: .* greater than or equal to 1"),
        ("data.steps=60", r"data.steps=60 is less than warm_up \+ horizon = 80"),
    ],
)
def test_wrong_words_end_in_one_sentence(
    word: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = overridden(WORDS, [f"store={tmp_path}/left", word])
    assert door(tune_models, words, tune_models.ALIASES) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert re.search(says, line), line
    assert list(tmp_path.iterdir()) == []


def test_a_tracker_without_trials_ends_in_one_sentence(tmp_path: Path) -> None:
    settings = load_settings([*WORDS, f"store={tmp_path}"])
    runner = settings.runner.model_copy(update={"tracker": "csv"})
    other = settings.model_copy(update={"runner": runner})
    with pytest.raises(SettingsError, match=r"runner\.tracker=csv records no searches; use mlflow"):
        tune_models.make_trials(other)


@pytest.mark.slow(2)
def test_pruned_failed_and_reused_trials_are_runs_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    log, place = tmp_path / "log", tmp_path / "mlruns"
    log.mkdir()
    place.mkdir()
    (log / "fail-bad").touch()
    study = toy_study(place, log)
    study.recover()
    for x, mood in ((0.31, "good"), (0.5, "bad"), (0.31, "good"), (0.4, "good"), (0.45, "good")):
        study._study.enqueue_trial({"x": x, "mood": mood})
    study._study.enqueue_trial({"x": 0.95, "mood": "good"})

    tracker = MlflowTrials(place)
    tracker.open("first")
    (log / "interrupt").touch()
    assert search_toy(place, log, 7, tracker=tracker).exit_code == 130
    tracker.close("KILLED")
    again = MlflowTrials(place)
    again.open("first")
    parent = again.sweep.run_id
    assert search_toy(place, log, 7, tracker=again).exit_code == 0
    again.close("FINISHED")

    trials = toy_study(place, log).trials()
    runs = list(again.experiment.search(f"tags.study = '{study.name}'"))
    by_number = {int(run.data.tags["trial"]): run for run in runs}
    assert sorted(by_number) == [trial.number for trial in trials]
    assert len(runs) == len(trials) == 8
    states = {number: run.data.tags["state"] for number, run in by_number.items()}
    assert states[0] == "INTERRUPTED"
    assert sorted(states.values()) == ["COMPLETE"] * 5 + ["FAIL", "INTERRUPTED", "PRUNED"]
    status = {
        "COMPLETE": "FINISHED",
        "FAIL": "FAILED",
        "PRUNED": "FINISHED",
        "INTERRUPTED": "KILLED",
    }
    roles: dict[str, list[str]] = {}
    for number, run in by_number.items():
        tags = run.data.tags
        assert tags["mlflow.parentRunId"] == parent
        assert run.info.status == status[tags["state"]]
        roles.setdefault(tags["state"], []).append(tags["role"])
        trial = trials[number]
        if trial.value is not None and tags["state"] == "COMPLETE":
            assert run.data.metrics["validation_loss"] == trial.value
        if tags["state"] == "FAIL":
            assert tags["error"].startswith("ValueError: this toy is in a bad mood (")
        if tags["state"] == "PRUNED":
            name = "model/validation_loss_on_the_way"
            history = again.experiment.client.get_metric_history(run.info.run_id, name)
            assert [(m.step, m.value) for m in history] == list(trial.intermediate_values.items())
    # The second 0.31 found the artifact of the first, which has the run of the node.
    assert sorted(roles["COMPLETE"]) == ["node"] * 4 + ["trial"]
