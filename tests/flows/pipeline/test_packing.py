"""A pack of lanes for which there is no room is halved, and its lanes come out as they would have.

There is no GPU here: the task itself raises what PyTorch raises when a GPU's memory runs out.
"""

import io
from pathlib import Path

import pytest
from rich.console import Console

from components.core.files import read_json
from flows.pipeline.executors.executor import Executor
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Node, Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.toys import counted, node

STEPS = 4


def pack(log: Path, room: int, lanes: int = 7) -> list[Node]:
    """Lanes of one program that takes so many at most, each with a node that needs it."""
    (log / "room").write_text(str(room))
    trained = [
        node("needs_room", f"lane{i}", log, lanes="p", number=i + 1, steps=STEPS)
        for i in range(lanes)
    ]
    judged = [node("total", f"judge{i}", log, {"a": lane}) for i, lane in enumerate(trained)]
    return [*judged, node("total", "sum", log, {n.name: n for n in judged})]


def run(nodes: list[Node], store: ArtifactStore, executor: Executor) -> tuple[Outcome, str]:
    text = io.StringIO()
    display = Display(Console(file=text, width=200))
    outcome = run_plan(Plan(nodes), store, NullTracker(), display, executor=executor)
    return outcome, text.getvalue()


@pytest.mark.parametrize("room", [1, 2, 6])
def test_a_pack_is_halved_until_there_is_room(store: ArtifactStore, log: Path, room: int) -> None:
    nodes = pack(log, room)
    outcome, said = run(nodes, store, SerialExecutor())
    assert (outcome.exit_code, len(outcome.finished)) == (0, 15)
    for number, one in enumerate(nodes[:-1], start=1):
        assert read_json(store.path(one.key) / "value.json") == number * STEPS
    assert "Memory ran out with 7 lanes, lane0 and others: going on with 3 and 4." in said
    # The parts went on from the checkpoint of the whole, which held one step.
    assert [counted(log, f"step-lane{i}") for i in range(7)] == [STEPS - 1] * 7
    assert list(store.work.iterdir()) == []
    record = store.record(nodes[-2].inputs["a"].key)
    assert (record["lanes"], record["resumed"]) == (min(room, 4), True)


def test_a_lane_for_which_there_is_no_room_at_all_fails_alone(
    store: ArtifactStore, log: Path
) -> None:
    nodes = pack(log, room=0, lanes=2)
    outcome, _ = run(nodes, store, SerialExecutor())
    lanes = {one.inputs["a"].key for one in nodes[:-1]}
    assert set(outcome.failed) == lanes
    assert all("Memory ran out: lower runner.cpus" in outcome.failed[key] for key in lanes)
    assert outcome.exit_code == 1


def test_a_resumed_pack_computes_only_what_is_missing(store: ArtifactStore, log: Path) -> None:
    run(pack(log, room=9, lanes=3), store, SerialExecutor())
    outcome, said = run(pack(log, room=2), store, SerialExecutor())
    assert (outcome.exit_code, len(outcome.reused)) == (0, 6)  # three lanes, what needs them
    assert "ran out with 4 lanes" in said
    assert [counted(log, f"finished-lane{i}") for i in range(7)] == [1] * 7
    assert list(store.work.iterdir()) == []


@pytest.mark.slow(10)
def test_workers_of_ray_halve_a_pack(store: ArtifactStore, log: Path) -> None:
    nodes = pack(log, room=2)
    outcome, said = run(nodes, store, RayExecutor(cpus=2))
    assert outcome.exit_code == 0, said
    assert read_json(store.path(nodes[-1].key) / "value.json") == STEPS * sum(range(1, 8))
    assert "ran out with 7 lanes" in said
    assert "ran out with 4 lanes" in said
    assert list(store.work.iterdir()) == []
