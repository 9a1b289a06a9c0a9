"""A report is written again if, and only if, it would be another one than there is."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from components.core.files import write_json
from components.core.sealed import seal
from components.environments import INDUSTRIAL_BENCHMARK_ID
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.report import report, shown
from flows.report.current import current_report
from tests.flows.pipeline.toys import record_of

WORDS = ["profile=smoke", "algorithms=[bc,lion]", "seeds=[0]", "evaluation.horizon=100"]
POINT = dict.fromkeys(["tenth_percentile", "standard_error", "mean", "std", "iqm"], -1.0)


class Card:
    name, environment = "mediocre-0.2", INDUSTRIAL_BENCHMARK_ID
    first_window_return_mean, return_steps, discount, trajectories = -2.0, 100, 0.97, 4


def finish(store: ArtifactStore, node: Node, files: dict[str, Any], sealed: bool = True) -> None:
    folder = store.path(node.key)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_json(folder / name, content)
    record = record_of(node.key, component=node.component)
    if sealed:
        seal(folder, record)
    else:
        write_json(folder / "node.json", record)


def finish_cell(store: ArtifactStore, node: Node, tenth: float | None, sealed: bool = True) -> None:
    label = node.config["algorithm"]
    proximities = [0.0, 1.0] if label == "lion" else [None]
    points = [
        {**POINT, "lambda": at, "policies": 1, "distance": 0.5, "seed_std": 0.1}
        | {"tenth_percentile": tenth}
        for at in proximities
    ]
    summary = {"dataset": "mediocre-0.2", "algorithm": label, "seeds": [0], "points": points}
    finish(store, node, {"summary.json": summary}, sealed)


class Sweep:
    """A finished sweep; counts how often its report is written."""

    def __init__(self, root: Path) -> None:
        self.plan = benchmark_plan(load_settings(WORDS))
        self.store, self.folder = ArtifactStore(root), root / "reports" / "sweep"
        self.cells = self.plan.by_component()["aggregation"]
        [self.data] = self.plan.by_component()["data_generation"]
        finish(self.store, self.data, {"dataset/card.json": {}})
        for number, cell in enumerate(self.cells):
            finish_cell(self.store, cell, -2.5 - number)
        self.written = 0

    def report(self, about: str = "one seed", plan: Plan | None = None) -> shown.Shown:
        # As another command does it, which has another store object.
        store = ArtifactStore(self.store.root)
        return current_report(self.folder, plan or self.plan, store, about)

    def content(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.folder.iterdir()}


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sweep:
    made = Sweep(tmp_path)
    write = report.write_report

    def counted(*arguments: Any) -> report.Report:
        made.written += 1
        return write(*arguments)

    monkeypatch.setattr(report.DatasetCard, "load", lambda path: Card)
    monkeypatch.setattr(report, "write_report", counted)
    return made


def test_an_unchanged_report_is_shown_and_not_written(sweep: Sweep) -> None:
    first = sweep.report()
    content = sweep.content()
    assert {"mediocre-0.2.png", "results.csv", "results.md", "report.json"} < content.keys()
    again = sweep.report()
    assert sweep.written == 1
    assert sweep.content() == content
    assert again.files == first.files
    assert again.headline == first.headline
    for width in (20, 40, 10_000):  # one column per block, two, all
        assert again.lines(width) == first.lines(width)
    assert "-2.5*" in "".join(again.lines(100))


def test_a_diverged_policy_stays_undefined(sweep: Sweep) -> None:
    finish_cell(sweep.store, sweep.cells[0], None)
    first, again = sweep.report(), sweep.report()
    assert sweep.written == 1
    assert "not finite" in "".join(again.lines(100))
    assert str(again.headline) == str(first.headline)  # NaN is not equal to itself
    assert "nan" in str(again.headline)


@pytest.mark.parametrize("name", ["mediocre-0.2.png", "results.csv", "results.md", "report.json"])
@pytest.mark.parametrize("damage", ["removed", "changed"])
def test_a_report_that_is_not_whole_is_written_again(sweep: Sweep, name: str, damage: str) -> None:
    sweep.report()
    whole = sweep.content()
    path = sweep.folder / name
    if damage == "removed":
        path.unlink()
    else:
        content = bytearray(path.read_bytes())
        content[-2] ^= 1
        path.write_bytes(content)
    sweep.report()
    assert sweep.written == 2
    assert sweep.content().keys() == whole.keys()
    assert sweep.content()["results.csv"] == whole["results.csv"]
    sweep.report()
    assert sweep.written == 2


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", None])
def test_what_is_shown_must_be_readable(sweep: Sweep, text: str | None) -> None:
    first = sweep.report()
    path = sweep.folder / "shown.json"
    if text is None:  # readable, and not what was written
        text = path.read_text("utf-8").replace("-2.5*", "-9.5*")
    path.write_text(text, encoding="utf-8")
    assert sweep.report().lines(100) == first.lines(100)
    assert sweep.written == 2


def _other_numbers(sweep: Sweep) -> None:
    finish_cell(sweep.store, sweep.cells[0], -7.0)


def _fewer_nodes(sweep: Sweep) -> None:
    sweep.store.set_aside(sweep.cells[0].key, sweep.store.place(sweep.cells[0].key))


def _more_nodes(sweep: Sweep) -> None:
    finish(sweep.store, sweep.plan.by_component()["policy_training"][0], {"policy.json": 1})


@pytest.mark.parametrize("change", [_other_numbers, _fewer_nodes, _more_nodes])
def test_other_nodes_are_another_report(sweep: Sweep, change: Callable[[Sweep], None]) -> None:
    sweep.report()
    change(sweep)
    lines = sweep.report().lines(100)
    assert sweep.written == 2
    assert lines == report.write_report(sweep.folder, sweep.plan, sweep.store).lines(100)


def test_another_selection_or_title_is_another_report(sweep: Sweep) -> None:
    sweep.report()
    fewer = benchmark_plan(load_settings([word.replace("bc,", "") for word in WORDS]))
    assert "bc" not in "".join(sweep.report(plan=fewer).lines(100))
    assert sweep.written == 2
    sweep.report()
    sweep.report("two seeds")
    assert sweep.written == 4


def test_another_ranking_is_another_report(sweep: Sweep) -> None:
    sweep.report()
    ranking = sweep.folder.parent / "ranked" / "ranking.csv"
    ranking.parent.mkdir()
    for number, guess in enumerate((0.1, 0.2)):
        ranking.write_text(f"dataset,proximity_from\nplant,{guess}\n", encoding="utf-8")
        sweep.report()
        sweep.report()
        assert sweep.written == 2 + number


@pytest.mark.parametrize("what", ["source", "settings", "library"])
def test_other_code_is_another_report(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    project = tmp_path / "project"
    source, settings = project / "flows" / "report.py", project / "conf" / "profile" / "paper.yaml"
    for path in (source, settings):
        path.parent.mkdir(parents=True)
        path.write_text("a: 1\n", encoding="utf-8")
    monkeypatch.setattr(shown, "_ROOT", project)
    sweep.report()
    sweep.report()
    assert sweep.written == 1
    if what == "library":
        monkeypatch.setattr(shown.metadata, "version", lambda name: "99")
    else:
        {"source": source, "settings": settings}[what].write_text("a: 2\n", encoding="utf-8")
    sweep.report()
    assert sweep.written == 2


def test_what_carries_no_digest_is_not_trusted(sweep: Sweep) -> None:
    finish_cell(sweep.store, sweep.cells[0], -3.0, sealed=False)
    sweep.report()
    sweep.report()
    assert sweep.written == 2
    assert "shown.json" not in sweep.content()


def test_a_node_that_changes_while_the_report_is_written_leaves_no_doubt(
    sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = report.write_report

    def disturbed(*arguments: Any) -> report.Report:
        written = write(*arguments)
        _other_numbers(sweep)
        return written

    monkeypatch.setattr(report, "write_report", disturbed)
    sweep.report()
    assert "shown.json" not in sweep.content()
    assert "-7.0" in "".join(sweep.report().lines(100))


def test_the_record_names_the_files_behind_it(sweep: Sweep) -> None:
    sweep.report()
    stored = json.loads(sweep.content()["shown.json"])
    names = sweep.content().keys() - {"shown.json"}
    assert stored["files"].keys() == names
    assert set(stored["published"]) == names - {"report.json"}
