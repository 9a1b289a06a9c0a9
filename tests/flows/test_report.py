"""The report of a sweep: variants of an algorithm, and commands that film robots."""

import csv
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from components.core.files import write_json
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.mujoco.specifications import HOPPER
from components.reporting.overview import Overview
from components.reporting.stored import open_report
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.render import load_render_settings
from flows.report import report
from flows.report.films import film_notes
from flows.report.graphs import graph_notes
from flows.report.software import software_notes
from flows.stored_policy import find_policy
from tests.flows.pipeline.toys import record_of

WORDS = [
    "profile=smoke", "algorithms=[mopo,lion]", "seeds=[0]", "mopo_penalties=[0,2.5]",
]  # fmt: skip
EMPTY = Overview([], {}, {})
POINT = dict.fromkeys(["tenth_percentile", "standard_error", "mean", "std", "iqm"], -1.0)


def finish(store: ArtifactStore, node: Node, files: dict[str, Any]) -> None:
    folder = store.work / f"made-{node.key}"
    for name, content in (
        {"node.json": record_of(node.key, component=node.component)} | files
    ).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_json(folder / name, content)
    store.publish(folder, node.key)


def test_variants_are_rows_of_the_table_and_stay_out_of_the_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*WORDS, "evaluation.horizon=100"]
    plan, store = benchmark_plan(load_settings(words)), ArtifactStore(tmp_path)
    for number, node in enumerate(plan):
        if node.component == "data_generation":
            finish(store, node, {"dataset/card.json": {"first_window_return_mean": -2.0}})
        if node.component == "aggregation":
            points = [{"lambda": None, "policies": 1, "distance": 0.0, **POINT, "mean": number}]
            label = node.config["algorithm"]
            summary = {"dataset": "mediocre-0.2", "algorithm": label, "seeds": [0]}
            finish(store, node, {"summary.json": summary | {"points": points}})

    class Card:
        trajectories = 10
        name, environment = "mediocre-0.2", INDUSTRIAL_BENCHMARK_ID
        first_window_return_mean, all_windows_return_mean = -2.0, -3.0
        return_steps, discount = 100, 0.97

    drawn, behaviour = [], []

    def draw(name: str, summaries: list[dict[str, Any]], mean: float, about: str) -> None:
        drawn.extend(summaries)
        behaviour.append((name, mean, about))

    monkeypatch.setattr(report.DatasetCard, "load", lambda path: Card)
    monkeypatch.setattr(report, "proximity_figure", draw)
    written = report.write_report(tmp_path / "reports" / "sweep", plan, store, "one seed")
    [table, _] = written.files
    labels = ["mopo-penalty-0", "mopo-penalty-2.5", "lion"]
    assert written.table["algorithm"].tolist() == labels
    assert {name.split("/")[2] for name in written.headline} == set(labels)
    with table.open(encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["algorithm"] for row in read] == labels
    assert len({row["mean"] for row in read}) == 3
    assert [summary["algorithm"] for summary in drawn] == ["lion"]
    assert behaviour == [
        ("mediocre-0.2", -2.0, "one seed")
    ]  # the first windows' mean, as policies are judged
    assert [s["algorithm"] for s in open_report(tmp_path, "sweep").summaries] == labels


def test_the_report_says_how_to_watch_the_policies_of_a_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, store = benchmark_plan(load_settings(WORDS)), ArtifactStore(tmp_path)
    policies = [node for node in plan if node.component == "policy_training"]
    for node in plan:
        if node.component == "data_generation":
            finish(store, node, {"dataset/card.json": {}})
        if node.component == "policy_training":
            finish(store, node, {})

    class Card:
        trajectories = 10
        name, first_window_return_mean, environment = "mediocre-0.2", 2.0, INDUSTRIAL_BENCHMARK_ID
        return_steps, discount = 100, 0.97

    monkeypatch.setattr(report.DatasetCard, "load", lambda path: Card)
    [_, text] = report.write_report(tmp_path / "industrial", plan, store).files
    assert "flows.render" not in text.read_text(encoding="utf-8")
    Card.environment = HOPPER.id
    [_, text] = report.write_report(tmp_path / "robot", plan, store).files
    lines = [line for line in text.read_text(encoding="utf-8").splitlines() if "watch" in line]
    assert len(lines) == len(policies) == 3
    for node, line in zip(policies, lines, strict=True):
        command = line.split("`")[1].split()
        assert line.startswith(f"- To watch {node.name.removesuffix('/seed0')}: ")
        settings = load_render_settings(command[3:])
        assert find_policy(store, settings.run)["key"] == node.key
        assert (settings.proximity is not None) == (node.config["algorithm"] == "lion")


def write_node(store: ArtifactStore, node: Node, software: Any) -> None:
    """Write the record of a node that was computed with some software; None: it does not tell."""
    folder = store.path(node.key)
    folder.mkdir(parents=True, exist_ok=True)
    record = {"key": node.key, "name": node.name, "component": node.component, "inputs": {}}
    record |= {"started": 0.0, "finished": 1.0, "seconds": 1.0}
    write_json(folder / "node.json", record | ({"software": software} if software else {}))


def made_with(store: ArtifactStore, plan: Plan, *records: Any) -> list[str]:
    """Notes on cells whose policies of seed 0, 1 ... were trained with the given software.

    Everything else was computed with the first.
    """
    for node in plan:
        seed = int(node.tags.get("seed", 0)) if node.component == "policy_training" else 0
        found = records[min(seed, len(records) - 1)]
        write_node(store, node, found)
    return software_notes(plan.by_component()["aggregation"], store)


CPU = {"torch": "2.13.0+cpu", "device": "AMD EPYC", "float32": "highest"}
GPU = {"torch": "2.11.0+cu128", "device": "NVIDIA H200", "float32": "high"}


def test_a_note_says_if_cells_come_from_different_software(tmp_path: Path) -> None:
    words = [*WORDS[:2], "datasets=[mediocre-0.2,bad-0.4]"]
    one, two = (benchmark_plan(load_settings([*words, s])) for s in ("seeds=[0]", "seeds=[0,1]"))
    store = ArtifactStore(tmp_path)
    assert made_with(store, one, CPU) == []
    assert made_with(store, one, None) == [], "what is unknown throughout is not mixed"
    cpu, gpu = "torch 2.13.0+cpu on AMD EPYC", "torch 2.11.0+cu128 on NVIDIA H200"
    start = "The cells come from different software or devices:"
    assert made_with(store, two, CPU, GPU) == [
        f"{start} {gpu} in high float32 precision and {cpu} (4 cells)."
    ]
    assert made_with(store, two, CPU, None) == [f"{start} {cpu} and unknown software (4 cells)."]
    # Cells of another dataset, computed elsewhere: none is mixed by itself, the table is.
    other = [node for node in one if node.tags["dataset"] == "bad-0.4"]
    made_with(store, one, CPU)
    for node in other:
        write_node(store, node, CPU | {"device": "Xeon"})
    cells = one.by_component()["aggregation"]
    assert software_notes(cells[:3], store) == [
        f"{start} {cpu} (2 cells), torch 2.13.0+cpu on Xeon (1 cell)."
    ]
    # Data are the same bytes everywhere, and means are of the same numbers.
    assert software_notes(cells[:2], store) == []
    for node in one:
        if node.component in ("data_generation", "aggregation"):
            write_node(store, node, GPU)
    assert software_notes(cells[:2], store) == []


def test_the_report_shows_the_note_on_software() -> None:
    written = report.Report(
        [], pd.DataFrame(), EMPTY, [], {}, ["The cells come from different software."]
    )
    assert written.lines(100) == ["Note: The cells come from different software."]


def test_films_are_those_of_the_first_seed() -> None:
    words = [word for word in WORDS if not word.startswith("seeds")]
    plan = benchmark_plan(load_settings([*words, "seeds=[0,1]"]))
    first = [n for n in plan if n.component == "policy_training" and n.tags["seed"] == "0"]
    notes = film_notes(plan, {"mediocre-0.2"})
    assert len(notes) == len(first) == 3
    for node, note in zip(first, notes, strict=True):
        assert f" run={node.key} " in note
    assert film_notes(plan, {"hopper"}) == []


def test_the_headline_is_the_best_proximity_s_and_all_are_a_curve_over_its_percent() -> None:
    def summary(algorithm: str, *points: tuple[float | None, float]) -> dict[str, Any]:
        stored = [{"lambda": x, **POINT, "tenth_percentile": y} for x, y in points]
        return {"dataset": "bad-0.4", "algorithm": algorithm, "points": stored}

    summaries = [
        summary("lion", (0.0, -9.0), (0.55, -7.0), (1.0, -8.0)),
        summary("bc", (None, -6.0)),
    ]
    assert report.Report([], pd.DataFrame(), EMPTY, summaries, {}).headline == {
        "tenth_percentile/bad-0.4/lion": [(0, -7.0)],
        "over_proximity/bad-0.4/lion": [(0, -9.0), (55, -7.0), (100, -8.0)],
        "tenth_percentile/bad-0.4/bc": [(0, -6.0)],
    }


def test_lost_graphs_are_noted_under_the_table(tmp_path: Path) -> None:
    words = ["profile=smoke", "algorithms=[bc]", "seeds=[0,1,2,3]"]
    plan, store = benchmark_plan(load_settings(words)), ArtifactStore(tmp_path)
    policies = [node for node in plan if node.component == "policy_training"]
    for node in policies:
        write_node(store, node, None)
    assert graph_notes(plan.by_component()["policy_training"], store) == []
    for node in policies:
        record = store.record(node.key) | {"tags": {"graphs": "lost: updates: no room"}}
        write_json(store.path(node.key) / "node.json", record)
    [note] = graph_notes(policies, store)
    assert note == (
        "Trained without CUDA graphs, which may take ten times as long: "
        f"{', '.join(node.name for node in policies[:3])} and 1 more (updates: no room)."
    )
    written = report.Report([], pd.DataFrame(), EMPTY, [], {}, graphs=[note])
    assert written.lines(100) == [f"Note: {note}"]


def test_what_is_not_finite_is_noted_under_the_table(tmp_path: Path) -> None:
    words = ["profile=smoke", "algorithms=[lion]", "seeds=[0]"]
    plan, store = benchmark_plan(load_settings(words)), ArtifactStore(tmp_path)
    for node in plan:
        if node.component == "model_fitting":
            ended = {
                "behaviour_policy": {"training/ended_at": 120},
                "recurrent_ensemble": {"training/untrained_loss": 0.31234},
            }[node.config["model"]]
            finish(store, node, {"metrics.json": {"validation_loss": 0.5} | ended})
        if node.component == "aggregation":
            point = {"lambda": 0.0, "policies": 1, "distance": None, **POINT, "mean": None}
            summary = {"dataset": "mediocre-0.2", "algorithm": "lion", "seeds": [0]}
            summary |= {"points": [point], "undefined": {"0": 2}}
            finish(store, node, {"summary.json": summary})
    written = report.write_report(tmp_path / "reports" / "sweep", plan, store)
    model, learned, returns = written.notes
    assert model == (
        "behaviour_policy on mediocre-0.2: its loss was no longer finite at update 120; its state "
        "of lowest held-out loss is used."
    )
    assert learned == (
        "recurrent_ensemble on mediocre-0.2: the fit has learned nothing, as its held-out loss "
        "never fell below the 0.312 of the untrained networks; lower its learning rate."
    )
    assert returns.startswith("lion on mediocre-0.2, seed 0: 2 of its pooled returns and distances")
    text = (tmp_path / "reports" / "sweep" / "results.md").read_text()
    assert f"- {model}\n- {learned}\n- {returns}" in text
    assert "not finite" in text
    assert f"Note: {model}" in written.lines(100)
    [shown] = open_report(tmp_path, "sweep").summaries
    assert shown["points"][0]["mean"] != shown["points"][0]["mean"]
