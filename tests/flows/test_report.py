"""The report of a sweep: variants of an algorithm, and commands that film robots."""

import csv
from pathlib import Path
from typing import Any

import pytest

from components.core.files import write_json
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.mujoco.specifications import HOPPER
from components.reporting.stored import open_report
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.render import find_policy, load_render_settings
from flows.report import report

WORDS = [
    "profile=smoke", "algorithms=[mopo,lion]", "seeds=[0]", "mopo_penalties=[0,2.5]",
]  # fmt: skip
POINT = dict.fromkeys(["tenth_percentile", "standard_error", "mean", "std", "iqm"], -1.0)


def finish(store: ArtifactStore, node: Node, files: dict[str, Any]) -> None:
    folder = store.work / f"made-{node.key}"
    for name, content in (
        {"node.json": {"key": node.key, "component": node.component}} | files
    ).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_json(folder / name, content)
    store.publish(folder, node.key)


def test_variants_are_rows_of_the_table_and_stay_out_of_the_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, store = benchmark_plan(load_settings(WORDS)), ArtifactStore(tmp_path)
    for number, node in enumerate(plan):
        if node.component == "data_generation":
            finish(store, node, {"dataset/card.json": {}})
        if node.component == "aggregation":
            points = [{"lambda": None, "policies": 1, "distance": 0.0, **POINT, "mean": number}]
            label = node.config["algorithm"]
            summary = {"dataset": "mediocre-0.2", "algorithm": label, "seeds": [0]}
            finish(store, node, {"summary.json": summary | {"points": points}})

    class Card:
        name, first_window_return_mean, environment = "mediocre-0.2", -2.0, INDUSTRIAL_BENCHMARK_ID

    drawn = []
    monkeypatch.setattr(report.DatasetCard, "load", lambda path: Card)
    monkeypatch.setattr(
        report, "proximity_figure", lambda name, summaries, mean: drawn.extend(summaries)
    )
    written = report.write_report(tmp_path / "reports" / "sweep", plan, store)
    [table, _] = written.files
    labels = ["mopo-penalty-0", "mopo-penalty-2.5", "lion"]
    assert written.table["algorithm"].tolist() == labels
    assert {name.split("/")[2] for name in written.headline} == set(labels)
    with table.open(encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["algorithm"] for row in read] == labels
    assert len({row["mean"] for row in read}) == 3
    assert [summary["algorithm"] for summary in drawn] == ["lion"]
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
        name, first_window_return_mean, environment = "mediocre-0.2", 2.0, INDUSTRIAL_BENCHMARK_ID

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
