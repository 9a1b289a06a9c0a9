"""Hyperparameter search: ``python -m flows.tune_models datasets=[mediocre-0.2] trials=30``.

Searches the settings of supervised models on held-out trajectories. This door only wires: datasets
are generated first if they are missing; the search itself, :mod:`flows.tuning`, knows no
environment.
"""

import json
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import date
from pathlib import Path

from optuna.trial import TrialState

from flows.command_line import Metrics, command_words, main, make_executor, run_sweep
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan, digest
from flows.pipeline.progress import Display
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import check_model, data_plan, model_node, sweep_name
from flows.planning.model_choice import tuned_folder
from flows.tuning.search import search
from flows.tuning.space import PASTS, SPACES
from flows.tuning.study import Study, Subject, ended_trials, open_journal
from flows.tuning.trial_tracker import TrialTracker
from flows.tuning.tuned_file import TunedModel, write_tuned

HELP = """\
usage: python -m flows.tune_models [KEY=VALUE ...]

Search architecture, learning rate, schedule, weight decay, batch and, where a model has them,
history and target form of supervised models, on held-out trajectories. The first trial is the
default configuration. Everything is kept under mlruns/; the same command continues a search, also a
killed one, and a larger number of trials extends it.

  datasets=[a,b]               names in conf/dataset, or all
  models=[a,b]                 names in conf/model, or all; recurrent_ensemble is the default
  trials=30                    per dataset and model
  model.NAME.KEY=VALUE         where the search of a model starts, e.g. model.action_vae.epochs=20
  models.folder=conf/tuned     where the winners are written, as DATASET/MODEL.yaml
  profile=smoke|quick|paper    budgets of the fits and selection of datasets; paper is the default
  dry_run=true                 show what would be searched and stop

Use the winners:  python -m flows.full_benchmark models=tuned
Look at a search: pip install optuna-dashboard, then optuna-dashboard mlruns/optuna/journal.log;
                  in MLflow (python -m flows.ui) every trial is a run with the tags study and trial.
"""

ALIASES = {"models": "tuning.models", "trials": "tuning.trials"}


def subjects(settings: Settings) -> list[Subject]:
    """What is searched: every chosen model on every chosen dataset."""
    data = {node.tags["dataset"]: node for node in data_plan(settings)}

    def subject(dataset: str, model: str) -> Subject:
        def node(config: object) -> Node:
            return model_node(model, config, dataset, data[dataset])

        space = SPACES[model]
        if settings.dataset[dataset].history == 1:
            space = {name: kind for name, kind in space.items() if name not in PASTS}
        return Subject(
            dataset, model, settings.model_on(dataset, model), space, data[dataset], node
        )

    return [subject(d, m) for d in settings.datasets for m in settings.tuning.models]


def winner(study: Study, store: ArtifactStore) -> TunedModel | None:
    """What the tuned file of a study says; None if no trial is complete."""
    best, start, subject = study.best(), study.start_trial(), study.subject
    if best is None:
        return None
    card = store.path(subject.data.key) / "dataset" / "card.json"
    started = start is not None and start.state is TrialState.COMPLETE
    return TunedModel(
        dataset=subject.dataset,
        model=subject.model,
        study=study.name,
        trial=best.number,
        trials=study.spent,
        validation_loss=best.value,
        default_validation_loss=start.value if started else None,
        data_digest=json.loads(card.read_text(encoding="utf-8"))["digest"],
        data_key=subject.data.key,
        date=date.today().isoformat(),
        settings=asdict(study.config(best)),
    )


def _generate(settings: Settings, plan: Plan, store: ArtifactStore) -> int:
    """Make the datasets that are missing; the only step that needs the machine."""
    if all(store.complete(node.key) for node in plan):
        return 0
    return run_sweep(settings, f"data-{sweep_name(settings, plan)}", plan, lambda outcome: ([], {}))


def _curves(studies: Sequence[Study]) -> Metrics:
    """Per study the lowest loss so far over the number of the trial."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for study in studies:
        best = float("inf")
        for trial in study.trials():
            if trial.state is TrialState.COMPLETE:
                best = min(best, trial.value)
                name = f"best_loss/{study.subject.dataset}/{study.subject.model}"
                curves.setdefault(name, []).append((trial.number, best))
    return curves


def _verdict(tuned: TunedModel) -> str:
    text = f"{tuned.dataset} {tuned.model}: trial {tuned.trial} of {tuned.trials} with a held-out "
    text += f"loss of {tuned.validation_loss:.6g}"
    default = tuned.default_validation_loss
    if default is None:
        return f"{text}; the default could not be evaluated"
    gain = 1.0 - tuned.validation_loss / default if default else 0.0
    return f"{text}; the default has {default:.6g} ({gain:.1%} less)"


def _journal(settings: Settings) -> Path:
    return settings.store.absolute() / "optuna" / "journal.log"


def _run(settings: Settings) -> int:
    found = subjects(settings)
    for subject in found:
        check_model(settings, subject.dataset, subject.start)
    plan = data_plan(settings)
    store = ArtifactStore(settings.store, create=not settings.dry_run)
    if settings.dry_run:
        for study, ended in ended_trials(_journal(settings), found).items():
            print(f"{study}: {ended} of {settings.tuning.trials} trials have ended")
        return 0
    code = _generate(settings, plan, store)
    if code:
        return code
    console = Display()
    name = settings.sweep or f"tune-{digest([subject.name for subject in found], 4)}"
    command = shlex.join(["python", *command_words()])
    console.note(f"Search {name} in {settings.store}/; journal {_journal(settings)}")
    tracker = TrialTracker(settings.store, source=command_words()[1])
    tracker.open_sweep(
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
    verdicts: dict[str, str] = {}
    studies: list[Study] = []
    try:
        journal = open_journal(_journal(settings))
        studies = [Study(subject, journal) for subject in found]

        def finished(study: Study) -> None:
            tuned = winner(study, store)
            if tuned is not None:
                files.append(write_tuned(tuned_folder(settings), tuned))
                verdicts[study.name] = f"{_verdict(tuned)}; {files[-1]}"

        outcome = search(
            studies,
            settings.tuning.trials,
            store,
            tracker,
            make_executor(settings),
            console.note,
            finished,
        )
        status = outcome.status
    finally:
        with suppress(KeyboardInterrupt):
            tracker.close_sweep(status, files, _curves(studies))
    for line in verdicts.values():
        print(line)
    _explain(console, command, outcome.interrupted, outcome.failed, outcome.unrecorded)
    return outcome.exit_code


def _explain(
    console: Display, command: str, interrupted: bool, failed: Sequence[str], unrecorded: str
) -> None:
    if interrupted:
        console.note(f"Interrupted; nothing finished is lost. Continue with: {command}")
    for study in failed:
        console.note(f"No trial of {study} could be evaluated.")
    if unrecorded:
        console.note(f"Some trials are not in MLflow yet: {unrecorded} Record them with: {command}")


if __name__ == "__main__":
    main("tune_models", HELP, _run, ALIASES)
