"""`flows.project`: measured rates become hours of plans on machines, and say what they rest on."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.learner_paths import RATES
from benchmarks.projection import compared
from benchmarks.records import Results, Row, row_of_seconds
from benchmarks.settings import Settings as Measurement_
from components.algorithms import ALGORITHMS
from components.data.sizes import DataSizes
from components.models import MODELS
from flows.configuration.checking import SettingsError
from flows.pipeline.computer import processor
from flows.pipeline.costs import CostModel, Measurement
from flows.pipeline.plan import Plan
from flows.pipeline.schedule import Group, form_groups
from flows.pipeline.store import ArtifactStore
from flows.planning.projection import Machine, cost_model, project
from flows.planning.rates import read_rates
from flows.project import load_projection_settings, main, projected
from tests.flows.pipeline.toys import node

SLICE = ("datasets=[mediocre-0.2]", "algorithms=[td3_bc,bc]", "seeds=[0,1,2,3,4]")


def row(kind: str, seconds: float, **rate: Any) -> Row:
    """A row of a learner's five lanes on two threads, unless `rate` says otherwise."""
    told = {
        "component": "policy_training", "kind": kind, "device": "cpu", "lanes": 5, "threads": 2,
        "processes": 1, "settings": {"updates": 1}, **rate,
    }  # fmt: skip
    return row_of_seconds("u", kind, [seconds], rate=told)


def results(path: Path, *rows: Row, **computer: str) -> Path:
    described = {"date": "2026-11-29", "model": processor(), "device": "cpu"} | computer
    Results(described, list(rows)).write(path)
    return path


def measured(kind: str, cost: float, seconds: float, **more: Any) -> Measurement:
    return Measurement(component="toys", kind=kind, cost=cost, seconds=seconds, **more)


def test_rates_are_held_against_the_cost_that_a_plan_gives_the_same_work(tmp_path: Path) -> None:
    fit = row("behaviour_policy", 3.0, component="model_fitting", lanes=1, threads=1,
              settings={"epochs": 2}, transitions=20_000)  # fmt: skip
    acting = row("td3_bc", 0.5, component="evaluation", lanes=1, threads=1, states=1000)
    rates = read_rates(results(tmp_path / "r.json", row("bc", 0.1, threads=1), fit, acting))
    learner, model, evaluation = rates.measurements
    config = ALGORITHMS["bc"].config
    assert learner.cost == pytest.approx(5e-4 * ALGORITHMS["bc"].cost(config(), DataSizes()))
    assert (learner.lanes, learner.seconds, learner.model) == (5, 0.1, processor())
    kind = MODELS["behaviour_policy"]
    assert model.cost == pytest.approx(
        kind.cost(kind.config(), DataSizes()) * 2 / kind.config().epochs / 5
    )
    assert evaluation.component == "evaluation"
    assert not rates.notes


def test_rates_of_all_threads_become_those_of_one_core_among_busy_ones(tmp_path: Path) -> None:
    alone = [row("bc", 0.1), row("bc", 0.3, lanes=20), row("td3_bc", 1.0), row("cql", 5.0)]
    beside = [row("bc", 0.14, processes=2), row("td3_bc", 1.6, processes=2)]
    rates = read_rates(results(tmp_path / "r.json", *alone, *beside))
    assert [m.seconds for m in rates.measurements] == pytest.approx([0.14, 0.42, 1.6, 7.5])
    assert "1.50 times as long" in rates.notes[0]
    rates = read_rates(results(tmp_path / "r.json", *alone))
    assert [m.seconds for m in rates.measurements] == pytest.approx([0.2, 0.6, 2.0, 10.0])
    assert rates.notes == ("2 threads are assumed to work 2 times as fast as one.",)
    card = row("cql", 5.0, device="cuda")
    rates = read_rates(results(tmp_path / "r.json", card, GPU="NVIDIA X"))
    assert [(m.seconds, m.model) for m in rates.measurements] == [(5.0, "NVIDIA X")]


def test_what_benchmarks_tell_of_a_rate_can_be_read(tmp_path: Path) -> None:
    told = Measurement_(threads=2).rate("policy_training", "bc", lanes=1, settings={"updates": 1})
    path = results(tmp_path / "r.json", row_of_seconds("u", "bc", [3.0, 1.0, 2.0], rate=told))
    [found] = read_rates(path).measurements
    assert (found.kind, found.seconds) == ("bc", 4.0)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_update_that_is_timed_costs_what_a_further_one_costs(name: str, tmp_path: Path) -> None:
    settings = {"updates": 1, **RATES.get(name, {})}
    path = results(tmp_path / "r.json", row(name, 1.0, lanes=1, threads=1, settings=settings))
    [found] = read_rates(path).measurements
    record, usual = ALGORITHMS[name], DataSizes()
    config = record.config(**({"rollouts": 1} if name == "mopo" else {}))  # none are timed
    more = dataclasses.replace(config, updates=2 * config.updates)
    further = (record.cost(more, usual) - record.cost(config, usual)) / config.updates
    assert found.cost == pytest.approx(further, rel=0.02)  # MOPO's single virtual step


def test_finished_nodes_come_before_benchmarks_and_lend_them_their_overhead() -> None:
    here = {"model": "mine"}
    nodes = [measured("a", 1.0, 2.0, overhead=5.0, **here), measured("a", 1.0, 9.0, model="other")]
    rates = [measured("a", 1.0, 70.0, **here), measured("b", 1.0, 3.0, **here)]
    costs, sources = cost_model(nodes, rates, "cpu", "mine")
    assert costs.seconds([node("a", "n", Path(), cost=10.0)]) == 25.0
    assert costs.seconds([node("b", "n", Path(), cost=10.0)]) == 35.0
    assert sources == {("toys", "a"): "1 finished", ("toys", "b"): "benchmark"}


@pytest.fixture
def calls(tmp_path: Path) -> list[Group]:
    """Three sources of 3,600 s, and 7,200 s that read one of them."""
    made = [node("a", f"n{i}", tmp_path, number=i, cost=3600.0) for i in range(3)]
    last = node("b", "last", tmp_path, {"a": made[0]}, component="train", cost=7200.0)
    plan = Plan([*made, last])
    return form_groups(plan, [n.key for n in plan], ArtifactStore(tmp_path / "none", create=False))


@pytest.mark.parametrize(
    ("slots", "hours", "limit"), [(1, 5.0, "cores"), (9, 3.0, "critical path")]
)
def test_hours_are_those_of_the_schedule(
    calls: list[Group], slots: int, hours: float, limit: str
) -> None:
    found = project(calls, Machine("m", slots), CostModel(), {})
    assert (found.hours, found.core_hours, found.critical_hours) == (hours, 5.0, 3.0)
    assert found.limit == limit
    share = found.shares["toys", "a"]
    assert (share.nodes, share.calls, share.core_hours, share.source) == (3, 3, 3.0, "guess")


def test_a_gpu_computes_what_was_measured_on_it_and_its_host_the_rest(calls: list[Group]) -> None:
    card = CostModel(device="cuda")
    card.add(measured("a", 1.0, 2.0, device="cuda"))
    found = project(calls, Machine("g", 4, gpu=True), CostModel(), {}, card)
    assert (found.gpu_hours, found.core_hours, found.hours) == (6.0, 2.0, 6.0)
    assert found.limit == "the GPU"
    nothing = project(calls, Machine("g", 4, gpu=True), CostModel(), {}, CostModel(device="cuda"))
    assert nothing.gpu_hours == 0.0


def test_a_slice_is_projected_on_all_machines(tmp_path: Path) -> None:
    mine = results(tmp_path / "r.json", row("td3_bc", 0.036, threads=1))
    words = [*SLICE, f"store={tmp_path / 'none'}", f"rates={mine}", "computers=3", "runner.cpus=2"]
    found = projected(*load_projection_settings(words))
    here, cluster, card = found.projections
    share = here.shares["policy_training", "td3_bc"]
    # 10,000 updates of five lanes at 36 ms each are six minutes
    assert (share.nodes, share.calls) == (5, 1)
    assert share.core_hours == pytest.approx(0.1)
    assert share.source == "benchmark"
    assert here.shares["policy_training", "bc"].source == "others of its component"
    assert here.shares["evaluation", "bc"].source == "guess"
    assert cluster.machine.slots == 6
    assert cluster.core_hours == here.core_hours
    # the stored rate of five lanes on the card, 1,838 updates/s
    assert card.shares["policy_training", "td3_bc"].gpu_hours == pytest.approx(10_000 / 1838 / 3600)
    assert "bc" in card.unmeasured
    assert "td3_bc" not in card.unmeasured
    assert any("before device-side draws" in note for note in found.notes)
    assert not (tmp_path / "none").exists()


def test_the_door_prints_a_table_or_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*SLICE, f"store={tmp_path / 'none'}", "rates=none", "runner.cpus=2"]
    for further in ([], ["format=json", "gpu_rates=none"]):
        monkeypatch.setattr(sys, "argv", ["project", *words, *further])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
    table, _, rest = capsys.readouterr().out.partition("{")
    assert "policy training" in table
    assert "one NVIDIA H200: " in table
    assert "No rates of benchmarks" in table
    told = json.loads("{" + rest)
    assert [m["machine"] for m in told["machines"]] == ["this computer", "10 computers like it"]
    names = {(s["component"], s["kind"]) for s in told["machines"][0]["shares"]}
    assert ("policy_training", "td3_bc") in names


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("rates={}/none.json", "none.json holds no results of benchmarks.run"),
        ("gpu_rates={}/other.json", "other.json holds no results of benchmarks.run"),
        ("computers=0", "computers"),
        ("format=xml", "format"),
        ("no_such=1", "no_such"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_sentence(tmp_path: Path, word: str, said: str) -> None:
    (tmp_path / "other.json").write_text("[1]")
    words = [*SLICE, f"store={tmp_path / 'store'}", word.format(tmp_path)]
    with pytest.raises(SettingsError, match=said) as refused:
        projected(*load_projection_settings(words))
    assert "\n" not in str(refused.value)


def test_a_projection_is_compared_with_what_ran() -> None:
    share = {"component": "toys", "kind": "a", "core_hours": 2.0, "source": "guess"}
    told = {"machines": [{"slots": 2, "hours": 1.5, "shares": [share]}]}
    record = {"component": "toys", "tags": {"algorithm": "a"}, "share": 0.5}
    record |= {"seconds": 4000.0, "cpu_seconds": 7200.0}  # of both; the rest was waited
    ran = [
        record | {"started": 0.0, "finished": 3600.0},
        record | {"started": 60, "finished": 7200},
    ]
    table, ratio = compared(told, ran)
    assert ratio == pytest.approx(0.75)
    assert "| toys | a | guess | 7,200.0 | 7,200.0 | 1.00 |" in table
