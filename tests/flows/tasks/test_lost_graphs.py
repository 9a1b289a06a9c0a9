"""A training that loses its graphs says so: in its artifact and below the table."""

from collections.abc import Callable
from pathlib import Path

import pytest

from components.algorithms.parts import training
from components.training.cuda_graphs import GraphedLearner
from components.training.recorded import RecordedGraphs
from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from flows.report.graphs import graph_notes
from tests.flows.grid import finished

WORDS = [
    "profile=smoke", "datasets=[mediocre-0.2]", "algorithms=[bc]", "seeds=[0,1]",
    "data.trajectories=4", "data.steps=110", "evaluation.horizon=10", "algorithm.bc.updates=8",
]  # fmt: skip


class Full(RecordedGraphs):
    """A device without room for a graph."""

    def capture(self, run: Callable[[], None]) -> Callable[[], None]:
        raise RuntimeError("no room")


def test_a_lost_graph_is_a_tag_and_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "graphed", lambda made, device: GraphedLearner(made, Full()))
    plan = benchmark_plan(load_settings(WORDS))
    with pytest.warns(UserWarning, match="No CUDA graph"):
        store = finished(plan, tmp_path)
    trained = plan.by_component()["policy_training"]
    for node in plan:
        lost = "lost: updates: no room" if node in trained else None
        assert store.record(node.key)["tags"].get("graphs") == lost
    [note] = graph_notes(plan, store)
    assert note.endswith(f"{trained[0].name}, {trained[1].name} (updates: no room).")
