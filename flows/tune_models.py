"""Hyperparameter search: ``python -m flows.tune_models datasets=[mediocre-0.2] trials=30``.

Searches the settings of supervised models on held-out trajectories. Missing datasets are generated
first; the search itself, :mod:`flows.tuning`, imports no environment.
"""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from optuna.storages import JournalStorage

from flows.command_line import COMMON_HELP, command_words, main, make_executor, run_sweep
from flows.configuration.settings import RUNNER_ALIASES, Settings, SettingsError
from flows.pipeline.executors.executor import Executor
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.limits import Limit
from flows.pipeline.plan import Node, Plan, digest
from flows.pipeline.progress import Display
from flows.pipeline.remote.places import address_of
from flows.pipeline.signals import ignored_signals
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, known_nodes
from flows.planning.benchmark import data_plan, sweep_name
from flows.planning.model_choice import tuned_folder
from flows.planning.sizes import check_model
from flows.planning.studies import study_specifications
from flows.tuning.file_trials import FileTrials
from flows.tuning.journal import journal_path, open_journal
from flows.tuning.mlflow_trials import MlflowTrials
from flows.tuning.results import best_losses, comparison, tuned_model
from flows.tuning.search import search
from flows.tuning.shown import OBJECTIVE, study_note, study_view
from flows.tuning.study import Study, StudySpecification, ended_trials
from flows.tuning.trials import NullTrials, Trials
from flows.tuning.tuned_file import write_tuned

HELP = f"""\
usage: python -m flows.tune_models [KEY=VALUE ...]

Search architecture, learning rate, schedule, weight decay, batch and, where a model has them,
history and target form of supervised models, on held-out trajectories. The first trial is the
default configuration. Everything is kept under mlruns/. To continue a search that was stopped, give
the same command again; a larger number of trials extends a search.

Use the best settings: python -m flows.full_benchmark models=tuned
Look at the trials:    pip install -e '.[dashboard]'; optuna-dashboard mlruns/optuna/journal.log;
                       in MLflow (python -m flows.ui) they are runs with the tags study and trial.

  profile=smoke|quick|paper       budgets and selection of datasets; paper is the default
  datasets=[a,b]                  names in conf/dataset, or all: every file there
  models=[a,b]                    names in components/models, or all; recurrent_ensemble by default
  trials=30                       per dataset and model
  model.NAME.KEY=VALUE            where its search starts, e.g. model.action_vae.epochs=20
  models.folder=conf/tuned        where the best settings are written, as DATASET/MODEL.yaml
{COMMON_HELP}"""

ALIASES = RUNNER_ALIASES | {"models": "tuning.models", "trials": "tuning.trials"}


def _generate(settings: Settings, plan: Plan, store: ArtifactStore) -> int:
    """Generate the datasets that are missing; the only step that needs the real system."""
    if all(store.intact(node.key, large=True) for node in plan):
        return 0
    return run_sweep(settings, f"data-{sweep_name(settings, plan)}", plan, lambda outcome: ([], {}))


def make_trials(settings: Settings) -> Trials:
    """The record of trials that `runner.tracker` names.

    Raises:
        SettingsError: This tracker has none.
        TrackingError: MLflow cannot be used.
    """
    match settings.runner.tracker:
        case "mlflow":
            return MlflowTrials(settings.store, source=command_words()[1])
        case "file":
            return FileTrials(settings.store)
        case "none":
            return NullTrials()
        case other:
            raise SettingsError(
                f"runner.tracker={other} records no searches; use mlflow, file or none."
            )


def _run(settings: Settings) -> int:
    if (url := address_of(settings.store)) is not None:
        raise SettingsError(
            f"A search keeps its journal in a folder; give store=FOLDER in place of store={url}."
        )
    limit = Limit(settings.runner.max_hours, settings.runner.until)
    found = study_specifications(settings)
    for specification in found:
        check_model(settings, specification.dataset, specification.start)
    plan = data_plan(settings)
    store = ArtifactStore(settings.store, create=not settings.dry_run)
    executor = make_executor(settings)
    if settings.dry_run:
        for study, ended in ended_trials(journal_path(settings.store), found).items():
            print(f"{study}: {ended} of {settings.tuning.trials} trials have ended")
        return 0
    journal = open_journal(journal_path(settings.store))  # a damaged one is named at once
    code = _generate(settings, plan, store)
    if code:
        return code
    with store_in_use(store):
        return _search(settings, found, journal, store, executor, limit.reached)


def _search(
    settings: Settings,
    found: Sequence[StudySpecification],
    journal: JournalStorage,
    store: ArtifactStore,
    executor: Executor,
    limit: Callable[[], str],
) -> int:
    console = Display()
    name = settings.sweep or f"tune-{digest([specification.name for specification in found], 4)}"
    command = shlex.join(["python", *command_words()])
    console.note(f"Search {name} in {settings.store}/; journal {journal_path(settings.store)}")
    tracker = make_trials(settings)
    tracker.open(
        name,
        {"profile": settings.profile_name, "command": command, "kind": "search"},
        {
            "datasets": ",".join(settings.datasets),
            "models": ",".join(settings.tuning.models),
            "trials": str(settings.tuning.trials),
        },
    )
    status = "FAILED"
    files: list[Path] = []
    comparisons: dict[str, str] = {}
    studies: list[Study] = []
    begun = known_nodes(store.root, name)

    def record(node: Node) -> None:
        begun[node.key] = node.name
        SweepRecord(name, command, begun).save(store.root)

    try:
        studies = [Study(specification, journal) for specification in found]
        # The record may be damaged, or lack the trials of an older version.
        begun |= {node.key: node.name for study in studies for _, node in study.begun()}
        SweepRecord(name, command, begun).save(store.root)
        place = tracker.show([study_view(study) for study in studies])
        for study in studies:
            study.describe(OBJECTIVE, study_note(study, settings.tuning.trials, place, command))
            if 0 < study.ended < settings.tuning.trials:
                about = f"{study.specification.dataset} {study.specification.model}"
                done = f"{study.ended} of {settings.tuning.trials} trials done"
                console.note(f"{about}: continuing: {done}")

        def finished(study: Study) -> None:
            tuned = tuned_model(study, store)
            if tuned is not None:
                files.append(write_tuned(tuned_folder(settings), tuned))
                comparisons[study.name] = f"{comparison(tuned)}; {files[-1]}"

        outcome = search(
            studies,
            settings.tuning.trials,
            store,
            tracker,
            executor,
            console.note,
            finished,
            record,
            limit,
        )
        status = outcome.status
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        with ignored_signals():
            tracker.close(status, files, best_losses(studies))
    for line in comparisons.values():
        print(line)
    _explain(console, command, bool(outcome.interrupted), outcome.failed, outcome.unrecorded)
    return outcome.exit_code


def _explain(
    console: Display, command: str, interrupted: bool, failed: Sequence[str], unrecorded: str
) -> None:
    if interrupted:
        console.note(f"Interrupted; nothing finished is lost. Continue with: {command}")
    for study in failed:
        console.note(f"No trial of {study} could be evaluated; the lines above say why.")
    if unrecorded:
        console.note(
            f"Some trials are not in the tracker yet: {unrecorded} Record them with: {command}"
        )


if __name__ == "__main__":
    main("tune_models", HELP, _run, ALIASES)
