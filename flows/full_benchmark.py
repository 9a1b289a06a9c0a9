"""The whole benchmark: ``python -m flows.full_benchmark profile=quick``."""

import json
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from components.algorithms import ALGORITHMS
from components.data.dataset import DatasetCard
from components.environments.rendering import DRAWABLE
from components.reporting.figures import proximity_figure, save_figure
from components.reporting.tables import (
    ended_notes,
    markdown_table,
    result_rows,
    results_csv,
)
from flows.command_line import Metrics, main, run_sweep
from flows.configuration.settings import Settings
from flows.pipeline.files import write_text
from flows.pipeline.plan import Node, Plan
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan, model_choice, sweep_name
from flows.render import film_command

__all__ = ["write_report"]

HELP = """\
usage: python -m flows.full_benchmark [KEY=VALUE ...]

Generate datasets, fit models, train policies, evaluate them in the real environment, aggregate and
report. Everything finished is kept under mlruns/ and reused; the same command continues a sweep.

  profile=smoke|quick|paper    budgets and selection; paper is the default
  datasets=[a,b]               names in conf/dataset, or all
  algorithms=[a,b]             names in conf/algorithm, or all
  seeds=[0,1]                  whole numbers
  models=tuned                 fit models with the settings that flows.tune_models has found
  models.per_seed=true         one fit of every model per policy seed instead of one for all
  mopo_penalties=sweep         one MOPO policy per penalty 0, 0.1 ... 2.5; or a list of numbers
  dry_run=true                 show the plan and stop
  sweep=NAME                   name of the sweep and its report folder
  algorithm.NAME.KEY=VALUE     any setting of conf/, e.g. algorithm.lion.updates=200
"""


def write_report(
    folder: Path, plan: Plan, store: ArtifactStore
) -> tuple[list[Path], list[dict[str, Any]], list[dict[str, Any]]]:
    """Write table and figures of everything that is finished.

    Args:
        folder: Made if needed.
        plan: Of the sweep.
        store: With its artifacts.

    Returns:
        The files, the rows and the summaries they show.
    """
    folder.mkdir(parents=True, exist_ok=True)
    done = [node for node in plan if store.complete(node.key)]
    judged = [node for node in done if node.component == "aggregation"]
    summaries = [
        json.loads((store.path(node.key) / "summary.json").read_text(encoding="utf-8"))
        for node in judged
    ]
    # Dozens of lines of one algorithm's variants would hide the others: these are in the table.
    drawn = [s for n, s in zip(judged, summaries, strict=True) if s["algorithm"] in n.tags.values()]
    rows = result_rows(summaries)
    table, text = folder / "results.csv", folder / "results.md"
    files, drawable = [table, text], set[str]()
    for node in done:
        if node.component != "data_generation":
            continue
        card_file = store.path(node.key) / "dataset" / "card.json"
        card = DatasetCard.from_json(card_file.read_text(encoding="utf-8"))
        if card.environment in DRAWABLE:
            drawable.add(card.name)
        figure = proximity_figure(
            card.name,
            [s for s in drawn if s["dataset"] == card.name],
            card.first_window_return_mean,
        )
        if figure is not None:
            files.append(folder / f"{card.name}.png")
            save_figure(figure, files[-1])
    write_text(table, results_csv(rows))
    said = [*ended_notes(summaries), *_unjudged(plan), *_films(done, drawable)]
    notes = "".join(f"\n- {note}" for note in said)
    write_text(text, markdown_table(rows) + (f"{notes}\n" if notes else ""))
    return files, rows, summaries


def _unjudged(plan: Plan) -> list[str]:
    """Of the datasets without a system to evaluate on, that there is none."""
    trained, judged = (
        {node.tags["dataset"] for node in plan if node.component == component}
        for component in ("policy_training", "evaluation")
    )
    return [
        f"{dataset} comes with no system to evaluate on, so its policies are stored and not judged."
        for dataset in sorted(trained - judged)
    ]


def _films(done: Sequence[Node], drawable: Collection[str]) -> list[str]:
    """How to watch the first seed of every algorithm on the datasets whose system has a picture."""
    shown: dict[str, str] = {}
    for node in done:
        if node.component != "policy_training" or node.tags["dataset"] not in drawable:
            continue
        name = node.name.rpartition("/")[0]
        takes_proximity = ALGORITHMS[node.config["algorithm"]].TAKES_LAMBDA
        # the key, since a name may be shared with other sweeps
        shown.setdefault(name, film_command(node.key, name, takes_proximity))
    return [f"To watch {name}: `{command}`" for name, command in shown.items()]


def _headline(summaries: Sequence[dict[str, Any]]) -> Metrics:
    """Per dataset and algorithm the 10th percentile, adaptive policies over 100 lambda."""
    return {
        f"tenth_percentile/{summary['dataset']}/{summary['algorithm']}": [
            (round(100 * (point["lambda"] or 0.0)), point["tenth_percentile"])
            for point in summary["points"]
        ]
        for summary in summaries
    }


def _run(settings: Settings) -> int:
    choice = model_choice(settings)
    plan = benchmark_plan(settings, choice)
    if settings.models.source == "tuned":
        for line in choice.lines():
            print(line, file=sys.stderr)
    name = sweep_name(settings, plan)
    folder = Path(settings.store) / "reports" / name

    def report(outcome: Outcome) -> tuple[list[Path], Metrics]:
        files, rows, summaries = write_report(folder, plan, ArtifactStore(settings.store))
        if rows:
            print(markdown_table(rows), end="")
        for note in [*ended_notes(summaries), *_unjudged(plan)]:
            print(f"Note: {note}")
        if rows:
            print(f"\nTable and figures: {folder}/")
        return files, _headline(summaries)

    return run_sweep(settings, name, plan, report)


if __name__ == "__main__":
    main("full_benchmark", HELP, _run)
