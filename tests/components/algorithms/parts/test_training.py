"""Snapshots and resumption of policy training: interrupted equals uninterrupted, bit for bit."""

import functools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import PolicyLearner
from components.algorithms.parts.training import snapshot_steps, train_policies
from components.policies.policy import Policy
from components.training.divergence import DivergedError
from components.training.loop import Curves
from tests.components.algorithms.stacks import graded, learner
from tests.components.interruption import KilledError, dying, lanes
from tests.components.synthetic import make_log, relabelled

LOGS = {"a": make_log("toy"), "b": make_log("toy"), "c": make_log("other", seed=3)}
SEEDS = {"a": 0, "b": 1, "c": 0}
UPDATES, SNAPSHOTS = 30, 5
every_algorithm = pytest.mark.parametrize("name", graded(ALGORITHMS, 1))


def train(
    name: str,
    work: Path,
    members: Sequence[str] = "abc",
    death: int | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[list[Policy], Curves]:
    logs = [LOGS[member] for member in members]
    made = learner(name, logs, [SEEDS[member] for member in members])
    made.update = dying(made.update, death)
    return train_policies(
        ALGORITHMS[name],
        made,
        logs,
        list(members),
        updates=UPDATES,
        snapshots=SNAPSHOTS,
        work=work,
        progress=progress,
        save_every=0.0,
    )


@functools.cache
def uninterrupted(name: str) -> tuple[list[Policy], Curves]:
    """What all interrupted runs of a learner must end with."""
    with tempfile.TemporaryDirectory() as work:
        return train(name, Path(work))


def pretraining(name: str) -> int:
    """Updates before the budget, of learners that have some."""
    made: PolicyLearner = learner(name, [LOGS["a"]], [0])
    return made.pretraining


def assert_same(ours: Sequence[Policy], theirs: Sequence[Policy]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert one.card == other.card
        for (w, b), (v, c) in zip(one.layers, other.layers, strict=True):
            assert torch.equal(w, v)
            assert torch.equal(b, c)


@every_algorithm
def test_snapshots_are_kept_at_equal_spacing(name: str) -> None:
    policies, curves = uninterrupted(name)
    assert [p.card.dataset for p in policies] == ["toy", "toy", "other"]
    steps = tuple(pretraining(name) + step for step in (6, 12, 18, 24, 30))
    assert [p.card.steps for p in policies] == [steps] * 3
    assert {p.lanes for p in policies} == {SNAPSHOTS}
    assert {p.card.takes_proximity for p in policies} == {ALGORITHMS[name].takes_proximity}
    weight = policies[0].layers[0][0]
    assert not any(torch.equal(weight[n], weight[n + 1]) for n in range(SNAPSHOTS - 1))
    for steps, _ in curves.of_lane(0).values():
        assert steps == sorted(set(steps))


@every_algorithm
@pytest.mark.parametrize("deaths", [[0], [1], [7], [13, 13], [5, 6, 29]])
def test_interrupted_equals_uninterrupted(name: str, deaths: list[int], tmp_path: Path) -> None:
    expected, curves = uninterrupted(name)
    for death in deaths:
        with pytest.raises(KilledError):
            train(name, tmp_path, death=death)
    found, again = train(name, tmp_path)
    assert_same(found, expected)
    assert lanes(again, 3) == lanes(curves, 3)


@pytest.mark.parametrize("name", ["brac", "td3_bc"])
def test_progress_is_that_of_the_budget(name: str, tmp_path: Path) -> None:
    told: list[float] = []
    train(name, tmp_path, progress=told.append)
    before, counted = told[: pretraining(name)], told[pretraining(name) : -1]
    assert before == [0.0] * len(before)
    assert counted == pytest.approx([(step + 1) / UPDATES for step in range(UPDATES)])
    assert told[-1] == 1.0


@every_algorithm
def test_part_of_the_lanes_is_finished_without_the_rest(name: str, tmp_path: Path) -> None:
    expected, _ = uninterrupted(name)
    with pytest.raises(KilledError):
        train(name, tmp_path, death=20)
    found, curves = train(name, tmp_path, "cb")
    assert found[0].card == expected[2].card
    for ours, theirs in zip(found, (expected[2], expected[1]), strict=True):
        for (w, _), (v, _) in zip(ours.layers, theirs.layers, strict=True):
            assert torch.equal(w[:3], v[:3])  # snapshots from before the interruption
            # ten updates with fewer lanes: float32 sums in another order
            torch.testing.assert_close(w[3:], v[3:], rtol=1e-3, atol=1e-5)
    last = [steps[-1] for steps, _ in curves.of_lane(0).values()]
    assert max(last) == UPDATES + pretraining(name)


@every_algorithm
def test_a_finished_run_is_only_read_again(name: str, tmp_path: Path) -> None:
    expected, _ = train(name, tmp_path)
    found, _ = train(name, tmp_path, death=0)  # any update would raise
    assert_same(found, expected)


class Breaking:
    """Its second lane's loss is undefined from an update on, and its weights after that."""

    def __init__(self, made: Any, at: int) -> None:
        self.lanes, self._made, self._at = made.lanes, made, at
        self.policy, self.act, self.pretraining = made.policy, made.act, made.pretraining
        self.state_dict = made.state_dict
        self.load_state_dict = made.load_state_dict

    def update(self, step: int) -> dict[str, torch.Tensor]:
        metrics = self._made.update(step)
        if step >= self._at:
            with torch.no_grad():
                for parameter in self._made._actor.parameters():
                    parameter[1] = torch.nan
        return metrics


def broken(at: int, work: Path) -> tuple[list[Policy | DivergedError], Curves]:
    """Three lanes, the second of which breaks."""
    logs = [LOGS[member] for member in "abc"]
    return train_policies(
        ALGORITHMS["ddpg"],
        Breaking(learner("ddpg", logs, [0, 1, 0]), at),
        logs,
        list("abc"),
        updates=UPDATES,
        snapshots=SNAPSHOTS,
        work=work,
        progress=lambda fraction: None,
    )


def assert_all_finite(work: Path) -> None:
    """Whatever was stored on the way is finite."""
    stored = sorted(work.glob("snapshot-*/*"))
    assert len(stored) == 3 * (SNAPSHOTS + 1)
    assert all(Policy.load(folder).finite.all() for folder in stored)


def test_a_lane_that_breaks_ends_and_its_neighbours_go_on(tmp_path: Path) -> None:
    expected, _ = uninterrupted("ddpg")
    policies, curves = broken(13, tmp_path)
    assert_same([policies[0], policies[2]], [expected[0], expected[2]])
    # The next update's loss is undefined, and the curves tell.
    assert curves.ended_at(1) == policies[1].card.ended_at == 15
    assert [p.card.ended_at for p in policies] == [None, 15, None]
    weight = policies[1].layers[0][0]
    assert torch.isfinite(weight).all()
    for number in range(1, SNAPSHOTS):  # the second is the last finite one
        assert torch.equal(weight[number], expected[1].layers[0][0][1])
    # The curves of the lane stop before that, the others' do not.
    assert max(steps[-1] for steps, _ in curves.of_lane(1).values()) == 14
    assert max(steps[-1] for steps, _ in curves.of_lane(0).values()) == UPDATES
    assert_all_finite(tmp_path)


def test_a_lane_that_breaks_before_its_first_snapshot_leaves_nothing(tmp_path: Path) -> None:
    expected, _ = uninterrupted("ddpg")
    policies, _ = broken(2, tmp_path)
    assert_same([policies[0], policies[2]], [expected[0], expected[2]])
    assert isinstance(policies[1], DivergedError)
    assert str(policies[1]) == (
        "its loss or its policy was no longer finite at update 4, before the first snapshot at "
        "update 6"
    )
    assert_all_finite(tmp_path)


def test_a_policy_that_acts_undefined_ends_although_loss_and_weights_are_finite(
    tmp_path: Path,
) -> None:
    class Growing(Breaking):
        def update(self, step: int) -> dict[str, torch.Tensor]:
            metrics = self._made.update(step)
            with torch.no_grad():  # infinite hidden units that cancel: undefined actions
                for parameter in self._made._actor.parameters():
                    parameter[1] = 3e38
                    parameter[1][::2] = -3e38
            return {name: value.nan_to_num() for name, value in metrics.items()}

    logs = [LOGS[member] for member in "abc"]
    policies, curves = train_policies(
        ALGORITHMS["ddpg"],
        Growing(learner("ddpg", logs, [0, 1, 0]), 0),
        logs,
        list("abc"),
        updates=UPDATES,
        snapshots=SNAPSHOTS,
        work=tmp_path,
        progress=lambda fraction: None,
    )
    assert curves.ended_at(1) is None
    assert isinstance(policies[1], DivergedError)
    assert_all_finite(tmp_path)


def test_a_policy_that_is_not_finite_at_the_start_is_refused(tmp_path: Path) -> None:
    log = make_log()
    poisoned = relabelled(log, frames=np.where(log.frames > 99.0, np.nan, log.frames))
    assert np.isnan(poisoned.frames).any()
    with pytest.raises(DivergedError, match=r"^before its first update the policy of ddpg on toy"):
        train_policies(
            ALGORITHMS["ddpg"],
            learner("ddpg", [poisoned], [0]),
            [poisoned],
            ["a"],
            updates=UPDATES,
            snapshots=SNAPSHOTS,
            work=tmp_path,
            progress=lambda fraction: None,
        )


def test_snapshot_steps() -> None:
    assert snapshot_steps(10_000, 20) == tuple(range(500, 10_001, 500))
    assert snapshot_steps(7, 3) == (2, 5, 7)
    assert snapshot_steps(3, 3) == (1, 2, 3)
    for updates, snapshots in ((2, 3), (5, 0)):
        with pytest.raises(ValueError, match="raise updates"):
            snapshot_steps(updates, snapshots)
