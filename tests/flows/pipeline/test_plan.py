"""Keys depend on what decides the result and on nothing else; plans are ordered and whole."""

from dataclasses import replace
from pathlib import Path

import pytest

from flows.pipeline.plan import Node, Plan, canonical_json

SOURCE = Node("data", "source", "pkg.tasks:make", 1, {"rows": 3})
NODE = Node("train", "node", "pkg.tasks:fit", 1, {"rate": 0.1, "sizes": [2, 3]}, {"data": SOURCE})


@pytest.mark.parametrize(
    "change",
    [
        {"name": "another"},
        {"tags": {"seed": "3"}},
        {"lanes": "together"},
        {"cost": 9.0},
        {"code": "3.11:0123456789abcdef"},
        {"task": "pkg.moved.elsewhere:fit"},
        {"config": {"sizes": (2, 3), "rate": 0.1}},
    ],
    ids=lambda change: next(iter(change)),
)
def test_key_ignores_what_cannot_change_the_result(change: dict) -> None:
    assert replace(NODE, **change).key == NODE.key


@pytest.mark.parametrize(
    "change",
    [
        {"component": "evaluate"},
        {"task": "pkg.tasks:other"},
        {"version": 2},
        {"config": {"rate": 0.2, "sizes": [2, 3]}},
        {"inputs": {}},
        {"inputs": {"other_role": SOURCE}},
        {"inputs": {"data": replace(SOURCE, version=2)}},
    ],
    ids=["component", "function", "version", "config", "no input", "role", "input's version"],
)
def test_key_depends_on_what_decides_the_result(change: dict) -> None:
    assert replace(NODE, **change).key != NODE.key


def test_key_is_stable_between_processes_and_releases() -> None:
    # A changed digest would orphan every stored artifact; if that is wanted, change this too.
    assert SOURCE.key == "61ec24d429582350c13da4a385b1db75"


def test_config_that_is_not_json_is_refused_with_the_nodes_name() -> None:
    with pytest.raises(ValueError, match=r"node 'node'.*JSON"):
        _ = replace(NODE, config={"path": Path("x")}).key
    with pytest.raises(ValueError, match=r"node 'node'.*JSON"):
        _ = replace(NODE, config={"value": float("nan")}).key


def test_task_must_be_an_import_path() -> None:
    with pytest.raises(ValueError, match="import path"):
        replace(NODE, task="pkg.tasks.fit")


def test_plan_adds_inputs_first_and_merges_equal_keys() -> None:
    twin = replace(NODE, name="twin")
    last = Node("collect", "last", "pkg.tasks:sum", 1, {}, {"a": NODE, "b": twin})
    plan = Plan([last, twin])
    assert [node.name for node in plan.nodes] == ["source", "node", "last"]
    assert plan.counts() == {"data": 1, "train": 1, "collect": 1}
    assert list(plan.by_component()) == ["data", "train", "collect"]
    assert [node.name for node in plan.dependents(NODE.key)] == ["last"]
    assert [node.name for node in plan.downstream(SOURCE.key)] == ["node", "last"]


def test_canonical_json_is_one_text_per_value() -> None:
    assert canonical_json({"b": 1, "a": [1.5, "ü"]}) == canonical_json({"a": (1.5, "ü"), "b": 1})
    assert canonical_json({"a": 1}) != canonical_json({"a": 1.0})
