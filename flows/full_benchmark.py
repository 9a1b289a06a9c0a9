"""The whole benchmark: ``python -m flows.full_benchmark profile=quick``."""

import sys
from collections.abc import Sequence
from pathlib import Path

from flows.command_line import (
    COMMON_HELP,
    Metrics,
    main,
    run_sweep,
    store_word,
    window_width,
)
from flows.configuration.settings import Settings
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan, model_choice, sweep_name
from flows.planning.cells import cells_line
from flows.report.current import current_report
from flows.report.leaderboard import Leaderboard

HELP = f"""\
usage: python -m flows.full_benchmark [KEY=VALUE ...]

Generate datasets, fit models, train policies, evaluate them in the real environment, aggregate and
report. Everything finished is kept under mlruns/ and reused. To continue a sweep that was stopped,
give the same command again.

  profile=smoke|quick|paper       budgets and selection; paper is the default
  datasets=[a,b]                  names in conf/dataset, or all: every file there that
                                  does not say by_name_only
  algorithms=[a,b]                names in components/algorithms, or all
  seeds=[0,1]                     whole numbers
  algorithm.NAME.KEY=VALUE        a setting of an algorithm, e.g. algorithm.lion.updates=200
  model.NAME.KEY=VALUE            a setting of a model, e.g. model.behaviour_policy.epochs=20
  models=tuned                    fit models with the settings that flows.tune_models has found
  models.per_seed=true            one fit of every model per policy seed instead of one for all
  models.folder=conf/tuned        folder of the tuned settings
  mopo_penalties=sweep            one MOPO policy per penalty 0, 0.1 ... 2.5; or a list of numbers
  data.seed=0                     of data generation, not of the learners
  data.trajectories=100           of an Industrial Benchmark dataset
  data.steps=1000                 per trajectory; of a robot at most
  data.transitions=1000000        of a robot dataset
  training.snapshots=20           policies kept per run
  evaluation.trajectories=10      per policy
  evaluation.horizon=100          steps per trajectory
  evaluation.proximity_step=0.05  distance of the proximities at which policies are evaluated
  evaluation.discount=0.99        of the returns that are shown; the log's own by default
  judging.policies=auto           judge policies of logs without a system from the log; or all, none
  judging.held_out=0.3            share of a log's episodes that judges learn from and policies not
  judging.snapshots=1             last policies of a run that are judged
  aggregation.pool_fraction=0.1   last share of the snapshots that enters the table
  pack=auto                       what one program trains: none, a policy; pair, the seeds of a
                                  dataset and algorithm; 2, of two datasets; algorithm, of all
{COMMON_HELP}"""


def _run(settings: Settings) -> int:
    choice = model_choice(settings)
    plan = benchmark_plan(settings, choice)
    if settings.models.source == "tuned":
        for line in choice.lines():
            print(line, file=sys.stderr)
    name = sweep_name(settings, plan)
    folder = Path(settings.store) / "reports" / name
    board = Leaderboard(plan, ArtifactStore(settings.store, create=False))

    def report(outcome: Outcome) -> tuple[Sequence[Path], Metrics]:
        seeds = len(settings.seeds)
        about = f"profile {settings.profile_name}, {seeds} {'seed' if seeds == 1 else 'seeds'}"
        shown = current_report(folder, plan, ArtifactStore(settings.store), about)
        for line in shown.lines(window_width()):
            print(line)
        if shown.has_page:
            print(f"\nAll numbers and figures: {folder}/")
            print(f"As a page: python -m flows.report sweep={name} store={store_word(settings)}")
        return shown.files, shown.headline

    about = cells_line(settings, plan)
    return run_sweep(settings, name, plan, report, about=about, board=board)


if __name__ == "__main__":
    main("full_benchmark", HELP, _run)
