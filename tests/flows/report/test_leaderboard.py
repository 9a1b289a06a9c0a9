"""Rows of the leaderboard from stored returns: the seed's own pool, best proximity, gain."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.core.files import write_json
from components.core.sealed import seal
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.board import Row
from flows.planning.benchmark import benchmark_plan
from flows.report import leaderboard
from flows.report.leaderboard import Leaderboard
from tests.flows.pipeline.toys import record_of

WORDS = [
    "profile=smoke", "algorithms=[lion,mopo]", "seeds=[3]", "mopo_penalties=[2.5]",
    "algorithm.lion.updates=20", "algorithm.mopo.updates=20", "training.snapshots=20",
]  # fmt: skip
GRID = np.array([0.0, 0.5, 1.0])


@pytest.fixture
def plan() -> Plan:
    # 20 snapshots, of which the last two are pooled.
    return benchmark_plan(load_settings(WORDS))


def evaluation(plan: Plan, algorithm: str) -> Node:
    nodes = plan.by_component()["evaluation"]
    [found] = [node for node in nodes if node.tags["algorithm"] == algorithm]
    return found


def row(plan: Plan, node: Node, home: Path, returns: np.ndarray, grid: Any, ended: Any = ()) -> Row:
    store = ArtifactStore(home)
    folder = store.work / "made"
    folder.mkdir()
    np.savez(
        folder / "returns.npz",
        lambdas=np.asarray(grid, dtype=float),
        returns=returns,
        distances=np.arange(returns.shape[0] * returns.shape[1]).reshape(returns.shape[:2]) / 10,
        steps=np.arange(len(returns)),
        ended_at=np.asarray(ended),
    )
    write_json(folder / "datasets.json", [{"name": "mediocre-0.2", "digest": "d", "source": "s"}])
    seal(folder, record_of(node.key, component="evaluation"))
    store.publish(folder, node.key)
    found = Leaderboard(plan, store).entry(node, store.path(node.key))
    assert found is not None
    return found.row()


def card(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    class Card:
        name, return_steps, discount, first_window_return_mean = "mediocre-0.2", steps, 0.97, -5.0

    monkeypatch.setattr(leaderboard.DatasetCard, "load", lambda path: Card)
    monkeypatch.setattr(ArtifactStore, "check", lambda *_, **__: {})


def test_a_row_pools_the_last_snapshots_of_its_seed_at_the_best_proximity(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    card(monkeypatch, 20)
    returns = np.full((20, 3, 2), -100.0)
    returns[-2:] = np.array([[[-4, -6], [-1, -3], [-9, -9]], [[-6, -8], [-2, -6], [-9, -9]]])
    found = row(plan, evaluation(plan, "lion"), tmp_path, returns, GRID)
    assert found.name == "mediocre-0.2/lion/seed3"
    numbers = {name: points[0][1] for name, points in found.metrics.items() if len(points) == 1}
    # The two policies have -2 and -4 at the proximity 0.5; a tenth of the way between them.
    assert numbers == pytest.approx(
        {
            "return/tenth_percentile": -3.8,
            "return/mean": -3.0,
            "return/best": -2.0,
            "return/behaviour": -5.0,
            "gain_over_behaviour": 1.2,
            "distance": (5.5 + 5.8) / 2,
            "proximity/best": 0.5,
            "proximity/return_at_0": -6.8,
            "proximity/return_at_1": -9.0,
        }
    )
    curve = found.metrics["over_proximity/tenth_percentile"]
    assert [step for step, _ in curve] == [0, 50, 100]
    assert [value for _, value in curve] == pytest.approx([-6.8, -3.8, -9.0])
    assert (
        found.params.items()
        >= {
            "dataset": "mediocre-0.2",
            "algorithm": "lion",
            "seed": "3",
            "snapshots": "20",
            "horizon": "20",
        }.items()
    )
    assert list(found.nodes) == [
        "policy", "data", "behaviour_policy", "recurrent_ensemble", "evaluation",
    ]  # fmt: skip
    assert found.datasets[0]["name"] == "mediocre-0.2"
    assert "the last 2 policies of the 20" in found.note
    assert "that of this seed's own policies" in found.note


def test_without_a_proximity_there_are_no_curves_and_a_variant_has_its_own_name(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    card(monkeypatch, 100)  # logged returns over other steps than the evaluation's
    returns = np.full((20, 1, 2), -7.0)
    found = row(plan, evaluation(plan, "mopo"), tmp_path, returns, [math.nan], [12])
    assert found.name == "mediocre-0.2/mopo-penalty-2.5/seed3"
    assert not {"gain_over_behaviour", "return/behaviour", "proximity/best"} & found.metrics.keys()
    assert found.tags == {
        "dataset": "mediocre-0.2",
        "algorithm": "mopo-penalty-2.5",
        "seed": "3",
        "takes_proximity": "no",
        "ended_at": "12",
    }
    assert "there is no gain" in found.note


def test_returns_that_are_not_finite_at_some_proximities_do_not_hide_the_others(
    tmp_path: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    card(monkeypatch, 20)
    returns = np.full((20, 3, 1), -7.0)
    returns[-1, 0] = math.inf
    found = row(plan, evaluation(plan, "lion"), tmp_path, returns, GRID)
    assert found.metrics["return/tenth_percentile"] == [(0, -7.0)]
    assert math.isnan(found.metrics["proximity/return_at_0"][0][1])


def test_a_row_is_another_one_for_another_pool(plan: Plan, tmp_path: Path) -> None:
    wider = benchmark_plan(load_settings([*WORDS, "aggregation.pool_fraction=0.5"]))
    node, store = evaluation(plan, "lion"), ArtifactStore(tmp_path)
    folder = store.work / "made"
    folder.mkdir()
    seal(folder, record_of(node.key))
    entries = [Leaderboard(p, store).entry(p[node.key], folder) for p in (plan, plan, wider)]
    abouts = [entry.about for entry in entries if entry is not None]
    assert abouts[0] == abouts[1] != abouts[2]


def test_only_evaluations_have_rows_and_every_dataset_and_algorithm_a_view(
    plan: Plan, tmp_path: Path
) -> None:
    board = Leaderboard(plan, ArtifactStore(tmp_path))
    for node in plan:
        if node.component != "evaluation":
            assert board.entry(node, tmp_path) is None
    views = {view.key: view for view in board.views()}
    assert {"dataset-mediocre-0.2", "algorithm-lion", "algorithm-mopo-penalty-2.5"} <= views.keys()
    assert views["proximity"].lines
    assert {key for key, view in views.items() if not view.board} == {
        "sweeps", "data", "models", "policies", "evaluations",
    }  # fmt: skip
