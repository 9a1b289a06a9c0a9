"""Lists of sweeps, watching, grids, remembered plans, and what cannot be shown."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from components.core.files import write_json
from flows.configuration.checking import SettingsError
from flows.pipeline.driver import DriverRecord, driving
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, read_sweep
from flows.status.__main__ import load_status_words, status
from flows.status.grid import grid
from flows.status.shown import lines
from flows.status.sweep_state import read_state
from flows.stop import load_stop_words, stop
from tests.flows.pipeline.toys import node


def told(store: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert status(load_status_words([f"store={store}", *words])) == 0
    return capsys.readouterr().out


def test_several_sweeps_are_listed_and_the_running_one_is_meant(
    store: ArtifactStore, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plans = {name: Plan([node("number", name, log, number=1)]) for name in ("one", "two")}
    for name, plan in plans.items():
        SweepRecord.of(name, f"make {name}", plan).save(store.root)
    text = told(store.root, capsys)
    assert text.count("0 of      1 nodes  no driver is known") == 2
    assert json.loads(told(store.root, capsys, "--json")) == {
        "sweeps": [
            {"sweep": name, "state": "unknown", "nodes": 1, "done": 0} for name in ("one", "two")
        ]
    }
    with pytest.raises(SettingsError, match="name the one to watch"):
        status(load_status_words([f"store={store.root}", "--watch"]))
    with pytest.raises(SettingsError, match="Several sweeps may be meant"):
        stop(load_stop_words([f"store={store.root}"]))
    with driving(store, "two", "make two", limited="at 07:00 on 2026-11-30"):
        assert told(store.root, capsys).startswith("Sweep two: running on ")
        assert "stops at 07:00 on 2026-11-30." in told(store.root, capsys)
        assert stop(load_stop_words([f"store={store.root}"])) == 0


def test_watching_ends_with_the_driver(
    store: ArtifactStore, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SweepRecord.of("toys", "make it so", Plan([node("number", "n", log, number=1)])).save(
        store.root
    )
    words = load_status_words([f"store={store.root}", "--watch", "--json"])
    with driving(store, "toys", "make it so") as driver:
        left = iter(range(3))

        def pause(seconds: float) -> None:
            if next(left) == 2:
                driver.end()

        assert status(words, pause) == 0
    states = [json.loads(line)["state"] for line in capsys.readouterr().out.splitlines()]
    assert states == ["running", "running", "running", "ended"]


def tagged(log: Path, name: str, **tags: str) -> Node:
    return replace(node("number", name, log, number=1), tags=tags)


def test_a_grid_tells_seeds_datasets_and_variants_apart(store: ArtifactStore, log: Path) -> None:
    kinds = [{"algorithm": "bc"}, *({"algorithm": "mopo", "penalty": p} for p in ("0.1", "0.2"))]
    nodes = [
        tagged(log, f"{kind}/{dataset}/{seed}", dataset=dataset, seed=seed, **kind)
        for dataset in ("a", "b")
        for kind in kinds
        for seed in ("0", "1")
    ]
    record = SweepRecord.of("toys", "make it so", Plan(nodes))
    store.path(nodes[0].key).mkdir()
    told_last = DriverRecord("toys", "id", "c", "h", 1, 0.0, 0.0, failed={nodes[-1].key: "no"})
    (store.root / "drivers").mkdir()
    write_json(store.root / "drivers" / "toys.json", vars(told_last))
    state = read_state(store, record)
    parts = grid(state)
    assert list(parts) == [
        (algorithm, dataset)
        for dataset in ("a", "b")
        for algorithm in ("bc", "mopo-penalty-0.1", "mopo-penalty-0.2")
    ]
    first, last = parts["bc", "a"], parts["mopo-penalty-0.2", "b"]
    assert (first.total, first.done, first.missing, first.fraction) == (2, 1, 1, 0.5)
    assert (last.failed, last.missing) == (1, 1)
    rows = [line.split() for line in lines(state, 0.0, 30) if line.startswith(("dataset", "b "))]
    assert rows == [  # as many columns as fit into thirty letters, then the others
        ["dataset", "bc", "mopo-penalty-0.1"],
        ["b", "0/2", "0/2"],
        ["dataset", "mopo-penalty-0.2"],
        ["b", "0/2", "✗1"],
    ]


def test_a_remembered_plan_is_the_plan(store: ArtifactStore, log: Path) -> None:
    source = node("number", "n", log, number=2, cost=3.0)
    plan = Plan([node("total", "t", log, {"a": source}, lanes="l")])
    SweepRecord.of("toys", "make it so", plan).save(store.root)
    found = read_sweep(store.root / "sweeps" / "toys.json").remembered()
    assert found is not None
    kept = ("key", "name", "component", "task", "version", "tags", "lanes", "cost")
    for ours, theirs in zip(found, plan, strict=True):
        assert [getattr(ours, k) for k in kept] == [getattr(theirs, k) for k in kept]
        assert {r: n.key for r, n in ours.inputs.items()} == {
            r: n.key for r, n in theirs.inputs.items()
        }
    broken = SweepRecord("toys", "c", {}, [{"key": "k"}])
    with pytest.raises(ValueError, match="plan in the record of sweep 'toys' is damaged; give"):
        broken.remembered()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["sweep=nobody"], "sweep=nobody: .* has no such sweep; there are: none"),
        ([], "has no such sweep; there are: none"),
        (["-v"], "'-v' is not a setting; write key=value, or --watch, or --json"),
        (["sweep=a", "sweep=b"], "sweep is given twice"),
        (["colour=blue"], "colour"),
        (["watch=maybe"], "watch"),
    ],
)
def test_what_cannot_be_shown_is_said(words: list[str], says: str, store: ArtifactStore) -> None:
    with pytest.raises(SettingsError, match=says):
        status(
            load_status_words(
                [*words, *([] if "store=nowhere" in words else [f"store={store.root}"])]
            )
        )


def test_a_store_without_runs_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=f"store={tmp_path} holds no runs"):
        status(load_status_words([f"store={tmp_path}"]))
