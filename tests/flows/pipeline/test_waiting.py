"""Which groups start next, whatever is withdrawn, divided or put back."""

from pathlib import Path

import pytest

from flows.pipeline.plan import Node
from flows.pipeline.schedule import Group
from flows.pipeline.waiting import Waiting
from tests.flows.pipeline.toys import node

LOG = Path("log")


def one(name: str) -> Node:
    return node("number", name, LOG, number=1)


@pytest.fixture
def chain() -> dict[str, Group]:
    """`a` and `b`; `c` of two nodes needs both; `d` needs `c`; the dearest start first."""
    groups = [
        Group("a", [one("a")], set(), priority=2.0),
        Group("b", [one("b")], set(), priority=3.0),
        Group("c", [one("c0"), one("c1")], {"a", "b"}),
        Group("d", [one("d")], {"c"}),
    ]
    return {group.name: group for group in groups}


def taken(waiting: Waiting) -> list[str]:
    """Names of all that is ready."""
    return [group.name for group in iter(waiting.take, None)]


def test_groups_start_in_order_once_what_they_need_has_ended(chain: dict[str, Group]) -> None:
    waiting = Waiting(chain.values())
    assert taken(waiting) == ["b", "a"]
    assert "c" in waiting
    waiting.left("a")
    assert taken(waiting) == []
    waiting.left("b")
    assert taken(waiting) == ["c"]
    assert [group.name for group in waiting] == ["d"]


def test_what_comes_back_keeps_others_waiting(chain: dict[str, Group]) -> None:
    waiting = Waiting(chain.values())
    assert taken(waiting) == ["b", "a"]
    waiting.left("a")
    waiting.add(chain["b"])
    assert taken(waiting) == ["b"]
    waiting.left("b")
    assert taken(waiting) == ["c"]


def test_what_needs_a_divided_group_waits_for_all_parts(chain: dict[str, Group]) -> None:
    waiting = Waiting(chain.values())
    for name in taken(waiting):
        waiting.left(name)
    assert taken(waiting) == ["c"]
    parts = [Group(f"c{i}", [part], set()) for i, part in enumerate(chain["c"].nodes)]
    waiting.divide(chain["c"], parts)
    assert sorted(taken(waiting)) == ["c0", "c1"]
    waiting.left("c0")
    assert taken(waiting) == []
    waiting.left("c1")
    assert taken(waiting) == ["d"]


def test_a_group_without_nodes_is_needed_no_more(chain: dict[str, Group]) -> None:
    waiting = Waiting(chain.values())
    waiting.withdraw([chain["c"].nodes[0].key, "unknown"])
    assert [n.name for n in chain["c"].nodes] == ["c1"]
    waiting.withdraw([chain["c"].nodes[0].key])
    assert "c" not in waiting
    assert taken(waiting) == ["b", "a", "d"]
