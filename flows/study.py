"""A study of the thesis from stored runs: ``python -m flows.study world``."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flows.command_line import (
    COMMON_HELP,
    Metrics,
    run_door,
    run_sweep,
    show_or_do,
    store_word,
    window_width,
)
from flows.configuration.checking import hint
from flows.configuration.settings import Settings, SettingsError, load_settings
from flows.pipeline.plan import Plan
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import sweep_name
from flows.report.current import Written, current
from flows.report.report import write_report
from flows.report.shown import Shown
from flows.studies import STUDIES
from flows.studies.study import Study


def _entry(study: Study) -> str:
    """What the help says of a study."""
    words = " ".join((*study.defaults, *study.quick))
    lines = [study.about, f"{study.takes}, with {words}"]
    wrap = textwrap.TextWrapper(72, break_long_words=False, break_on_hyphens=False).wrap
    wrapped = [line for text in lines for line in wrap(text)]
    return f"  {study.name}\n" + "\n".join(f"      {line}" for line in wrapped)


_LISTED = "\n".join(map(_entry, STUDIES.values()))
HELP = f"""\
usage: python -m flows.study NAME [KEY=VALUE ...]

Answer a question of the thesis: run what the study needs and the store lacks, then write its
figures and its table beside the thesis's numbers. Everything finished is kept under mlruns/ and
reused. To continue a study that was stopped, give the same command again.

{_LISTED}

Times are those of two idle cores. The words after `with` are replaced by those that are given;
`profile=paper` takes the thesis's budgets in place of all reduced ones, which may take days.

  profile=smoke|quick|paper       budgets
  datasets=[a,b]                  unless the study is about certain ones
  seeds=[0,1]                     whole numbers
  algorithm.NAME.KEY=VALUE        a setting of an algorithm, e.g. algorithm.lion.updates=200
  model.NAME.KEY=VALUE            a setting of a model, e.g. model.behaviour_policy.epochs=20
{COMMON_HELP}"""


@dataclass(frozen=True)
class _Chosen:
    """A study and the settings of its runs."""

    study: Study
    settings: Settings


def _load(words: Sequence[str]) -> _Chosen:
    """What a command line asks for.

    Raises:
        SettingsError: One sentence.
    """
    known = ", ".join(STUDIES)
    if not words or "=" in words[0]:
        raise SettingsError(f"name a study first, e.g. {next(iter(STUDIES))}; there are {known}.")
    name, *given = words
    if name not in STUDIES:
        raise SettingsError(f"Unknown study {name!r}; there are {known}.{hint(name, STUDIES)}")
    study = STUDIES[name]
    return _Chosen(study, load_settings(study.words(given)))


def _run(chosen: _Chosen) -> int:
    return show_or_do(chosen.settings, lambda settings: _study(chosen.study, settings))


def _study(study: Study, settings: Settings) -> int:
    plan = study.plan(settings)
    name = settings.sweep or f"{study.name}-{sweep_name(settings, plan)}"
    folder = settings.store / "reports" / name

    def report(outcome: Outcome) -> tuple[Sequence[Path], Metrics]:
        store = ArtifactStore(settings.store)
        about = f"study {study.name}"
        shown = current(folder, plan, store, about, lambda: _write(study, plan, store, folder))
        for line in shown.lines(window_width()):
            print(line)
        if _finished(plan, store):
            print(f"Figures and tables: {folder}/")
            if shown.headline:
                place = store_word(settings)
                print(f"As a page: python -m flows.report sweep={name} store={place}")
        return shown.files, shown.headline

    return run_sweep(settings, name, plan, report)


def _write(study: Study, plan: Plan, store: ArtifactStore, folder: Path) -> Written:
    """The report of a study's runs if they are policies', and what it has found if all ended."""
    folder.mkdir(parents=True, exist_ok=True)
    shown, others = Shown([], None, [], {}), []
    if "aggregation" in plan.by_component():
        written = write_report(folder, plan, store, f"study {study.name}")
        notes = [f"Note: {note}" for note in written.notes]
        shown = Shown(written.files, None, notes, written.headline)
        others = [written.nodes] if written.nodes else []
    if _finished(plan, store):
        drawn = study.draw(plan, store, folder)
        files, below = [*shown.files, *drawn.files], [*shown.below, *drawn.text.splitlines()]
        shown = replace(shown, files=files, below=below)
    return shown, others


def _finished(plan: Plan, store: ArtifactStore) -> bool:
    return all(store.complete(node.key) for node in plan)


if __name__ == "__main__":
    run_door("study", HELP, _load, _run, resumes=True)
