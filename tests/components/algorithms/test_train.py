"""Snapshots and resumption of policy training: interrupted equals uninterrupted, bit for bit."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.train import snapshot_steps, train_policies
from components.networks.policy import Policy
from components.networks.training import Curves
from tests.components.algorithms.stacks import learner
from tests.components.interruption import KilledError, dying, lanes
from tests.components.synthetic import make_log

LOGS = {"a": make_log("toy"), "b": make_log("toy"), "c": make_log("other", seed=3)}
SEEDS = {"a": 0, "b": 1, "c": 0}
UPDATES, SNAPSHOTS = 30, 5
every_algorithm = pytest.mark.parametrize("name", ALGORITHMS)


def train(
    name: str, work: Path, members: Sequence[str] = "abc", death: int | None = None
) -> tuple[list[Policy], Curves]:
    logs = [LOGS[member] for member in members]
    made = learner(name, logs, [SEEDS[member] for member in members])
    made.update = dying(made.update, death)
    return train_policies(
        name,
        made,
        logs,
        list(members),
        updates=UPDATES,
        snapshots=SNAPSHOTS,
        takes_lambda=ALGORITHMS[name].TAKES_LAMBDA,
        work=work,
        progress=lambda fraction: None,
        save_every=0.0,
    )


def assert_same(ours: Sequence[Policy], theirs: Sequence[Policy]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert one.card == other.card
        for (w, b), (v, c) in zip(one.layers, other.layers, strict=True):
            assert torch.equal(w, v)
            assert torch.equal(b, c)


@every_algorithm
def test_snapshots_are_kept_at_equal_spacing(name: str, tmp_path: Path) -> None:
    policies, curves = train(name, tmp_path)
    assert [p.card.dataset for p in policies] == ["toy", "toy", "other"]
    assert [p.card.steps for p in policies] == [(6, 12, 18, 24, 30)] * 3
    assert {p.lanes for p in policies} == {SNAPSHOTS}
    assert {p.card.takes_lambda for p in policies} == {ALGORITHMS[name].TAKES_LAMBDA}
    weight = policies[0].layers[0][0]
    assert not any(torch.equal(weight[n], weight[n + 1]) for n in range(SNAPSHOTS - 1))
    for steps, _ in curves.of_lane(0).values():
        assert steps == sorted(set(steps))


@every_algorithm
@pytest.mark.parametrize("deaths", [[0], [1], [7], [13, 13], [5, 6, 29]])
def test_interrupted_equals_uninterrupted(name: str, deaths: list[int], tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "work").mkdir()
    expected, curves = train(name, tmp_path / "whole")
    for death in deaths:
        with pytest.raises(KilledError):
            train(name, tmp_path / "work", death=death)
    found, again = train(name, tmp_path / "work")
    assert_same(found, expected)
    assert lanes(again, 3) == lanes(curves, 3)


@every_algorithm
def test_part_of_the_lanes_is_finished_without_the_rest(name: str, tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "work").mkdir()
    expected, _ = train(name, tmp_path / "whole")
    with pytest.raises(KilledError):
        train(name, tmp_path / "work", death=20)
    found, curves = train(name, tmp_path / "work", "cb")
    assert found[0].card == expected[2].card
    for ours, theirs in zip(found, (expected[2], expected[1]), strict=True):
        for (w, _), (v, _) in zip(ours.layers, theirs.layers, strict=True):
            assert torch.equal(w[:3], v[:3])  # snapshots from before the interruption
            # ten updates with fewer lanes: float32 sums in another order
            torch.testing.assert_close(w[3:], v[3:], rtol=1e-3, atol=1e-5)
    for steps, _ in curves.of_lane(0).values():
        assert steps[-1] == UPDATES


@every_algorithm
def test_a_finished_run_is_only_read_again(name: str, tmp_path: Path) -> None:
    expected, _ = train(name, tmp_path)
    found, _ = train(name, tmp_path, death=0)  # any update would raise
    assert_same(found, expected)


def test_snapshot_steps() -> None:
    assert snapshot_steps(10_000, 20) == tuple(range(500, 10_001, 500))
    assert snapshot_steps(7, 3) == (2, 5, 7)
    assert snapshot_steps(3, 3) == (1, 2, 3)
    for updates, snapshots in ((2, 3), (5, 0)):
        with pytest.raises(ValueError, match="raise updates"):
            snapshot_steps(updates, snapshots)
