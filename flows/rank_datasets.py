"""Which datasets promise most: ``python -m flows.rank_datasets datasets=[bad-0.4,optimized-0.6]``.

The indicators of thesis chapter 4 of any log, without its system: what copying the best episodes
could gain (ERI), how random the actions are (EAS), and both combined (COI).
"""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from components.core.files import write_text
from components.data.indicators import LogFacts, return_floor
from components.data.sources.stored_log import StoredLog
from components.models.action_stochasticity import ActionStochasticity
from components.reporting.figures import save_figure
from components.reporting.ranking import (
    Measured,
    clip_table,
    correlation_table,
    markdown,
    ranked_for_people,
    ranking_table,
)
from components.reporting.ranking_figures import clip_figure, ranking_figure
from flows.command_line import COMMON_HELP, Metrics, main, run_sweep
from flows.configuration.settings import RUNNER_ALIASES, Settings, SettingsError
from flows.pipeline.plan import Plan
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import sweep_name
from flows.planning.ranking import ranking_plan
from flows.report.achieved import Achieved, achieved
from flows.tasks.ranking import INDICATORS

HELP = f"""\
usage: python -m flows.rank_datasets [KEY=VALUE ...]

Rank datasets by what offline reinforcement learning can gain from them: ERI, EAS and COI of thesis
chapter 4, what limits each log, and a first guess of the proximities to try. Only the log is read;
datasets that the store lacks are generated first, which takes minutes for those of the robots.
Where a sweep has results on the same datasets, their true improvement and the correlations with it
stand beside it.

  datasets=[a,b]                  names in conf/dataset, or all: every file there, your logs too
  profile=chapter4                the sixteen datasets of thesis table 4.1
  floor=-350                      return that none falls below, of all datasets; by default that of
                                  the system where it is known, else every log's own least return
  report=SWEEP                    sweep whose policies tell the true improvement; by default the
                                  only one in the store that has results on these datasets
  algorithm=lion                  whose improvement is shown; moose by default, or else the first
  clip=0.9                        of actions before the inverse tanh, which decides EAS
  clips=[0.7,0.9,0.99]            what is shown beside it
  ranking.stochasticity.KEY=VALUE updates, batch, hidden, learning_rate of its fit
{COMMON_HELP}"""

ALIASES = RUNNER_ALIASES | {
    "floor": "ranking.floor",
    "report": "ranking.report",
    "algorithm": "ranking.algorithm",
    "clip": "ranking.stochasticity.clip",
    "clips": "ranking.stochasticity.clips",
}
_SHOWN = {
    "dataset": "dataset",
    "return_mean": "mean return",
    "return_max": "best",
    "eri": "ERI",
    "eas": "EAS",
    "tri": "TRI",
    "eri_rank": "ERI rank",
    "thesis_eri_rank": "thesis",
    "eas_rank": "EAS rank",
    "thesis_eas_rank": "thesis ",
    "coi_rank": "COI rank",
    "thesis_coi_rank": "thesis  ",
    "tri_rank": "TRI rank",
    "thesis_tri_rank": "thesis   ",
}
"""Columns of the table that is printed. Headings differ by blanks, which Markdown does not show."""
_DIGITS = {"return_mean": 1, "return_max": 1, "eri": 3, "eas": 3, "tri": 3}


def _measured(
    settings: Settings, plan: Plan, store: ArtifactStore, results: Achieved
) -> list[Measured]:
    """What the finished nodes have found, in the order of the settings."""
    logs = []
    for node in plan:
        if node.component != "indicators" or not store.complete(node.key):
            continue
        record = store.read_json(node.key, INDICATORS)
        facts = LogFacts.of_record(record["facts"])
        spread = ActionStochasticity.of_record(record["stochasticity"])
        try:
            floor = return_floor(facts, settings.ranking.floor)
        except ValueError as error:
            raise SettingsError(str(error)) from error
        logs.append(
            Measured(
                facts,
                floor,
                spread.eas,
                spread.expected,
                results.percentiles.get(facts.name, {}),
                generated=not isinstance(settings.dataset[facts.name], StoredLog),
            )
        )
    return logs


def _shown(table: pd.DataFrame) -> str:
    """The table that is printed."""
    shown = ranked_for_people(table)
    columns = {name: heading for name, heading in _SHOWN.items() if name in shown}
    if table.filter(like="thesis_").isna().all(axis=None):
        columns = {k: v for k, v in columns.items() if not k.startswith("thesis_")}
    digits = {v: _DIGITS.get(k, 0) for k, v in columns.items() if k != "dataset"}
    return markdown(shown[list(columns)].rename(columns=columns), digits)


def _sentences(table: pd.DataFrame) -> list[str]:
    """What is said of every dataset, in the order of the table."""
    return [
        f"{row.dataset}: {row.limit} First guess of λ: {row.proximity_from:.2f} to "
        f"{row.proximity_to:.2f}"
        + (
            f", since {row.terminated} of {row.episodes} episodes have ended for good."
            if row.terminated
            else "."
        )
        for row in table.itertuples()
    ]


def _written(
    folder: Path, logs: Sequence[Measured], settings: Settings, results: Achieved
) -> tuple[list[Path], Metrics]:
    """Print, write and return everything that is to be kept."""
    algorithm = results.algorithm(settings.ranking.algorithm)
    clip = settings.ranking.stochasticity.clip
    table, clips = ranking_table(logs, algorithm), clip_table(logs)
    parts = [_shown(table)]
    if len(table) > 1:
        theirs = "" if table.filter(like="thesis_").isna().all(axis=None) else "the thesis and "
        verb = "count" if theirs else "counts"
        parts.append(f"Ranks count from 1, the least; {theirs}ranking.csv {verb} from 0.\n")
    if algorithm:
        parts.append(f"TRI is the improvement by {algorithm}, in the sweep {results.sweep}.\n")
    correlations = correlation_table(logs)
    if not correlations.empty:
        digits = {
            name: 0 if name.startswith("datasets") else 2 for name in correlations.columns[1:]
        }
        parts.append("Spearman's rank correlations:\n\n" + markdown(correlations, digits))
    digits = {"clip": 3} | {name: 2 for name in clips.columns[1:]}
    orders = clips[["clip", "spearman_chosen", "spearman_thesis"]].dropna(axis=1, how="all")
    if len(orders.columns) > 1:  # a single dataset has no order
        parts.append(
            f"EAS depends on the clip ({clip:g} is used); the order of the datasets at others:\n\n"
            + markdown(orders, digits)
        )
    parts.append("".join(f"- {line}\n" for line in _sentences(table)))
    parts.append(
        "The guess of λ is a heuristic from EAS alone (thesis 7.2): begin at its lower end, go up "
        "in steps and watch the machine.\n"
    )
    if results.note:
        parts.append(results.note + "\n")
    text = "\n".join(parts)
    print(text)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in _FILES]
    write_text(files[0], table.to_csv(index=False, lineterminator="\n"))
    write_text(files[1], clips.to_csv(index=False, lineterminator="\n"))
    write_text(files[2], text)
    save_figure(ranking_figure(logs, algorithm), files[3])
    save_figure(clip_figure(logs, clips, clip), files[4])
    print(f"Table and figures: {folder}/")
    metrics = {
        f"{name}/{row.dataset}": [(0, float(getattr(row, name)))]
        for row in table.itertuples()
        for name in ("eri", "eas", "coi_rank")
    }
    return files, metrics


_FILES = ("ranking.csv", "eas_over_clips.csv", "ranking.md", "ranking.png", "eas_over_clips.png")


def _run(settings: Settings) -> int:
    plan = ranking_plan(settings)
    generations = plan.by_component()["data_generation"]
    keys = {node.tags["dataset"]: node.key for node in generations}
    results = achieved(settings.store, keys, settings.ranking.report)
    results.algorithm(settings.ranking.algorithm)  # refused before anything starts
    store = ArtifactStore(settings.store, create=not settings.dry_run)
    name = f"ranking-{sweep_name(settings, plan)}"

    def report(outcome: Outcome) -> tuple[list[Path], Metrics]:
        logs = _measured(settings, plan, store, results)
        if not logs:
            return [], {}
        return _written(settings.store / "reports" / name, logs, settings, results)

    params = {"datasets": ",".join(settings.datasets), "report": results.sweep}
    return run_sweep(settings, name, plan, report, params)


if __name__ == "__main__":
    main("rank_datasets", HELP, _run, ALIASES)
