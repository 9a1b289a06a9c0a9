"""The autopilot of the library."""

from dataclasses import replace

import pytest

import proximity_bench as pb
from tests.library.test_operating import LION, LOG


def test_it_flies_in_the_system_of_the_log() -> None:
    found = pb.autopilot(LION, budget=4, warm_up=3, seed=5)
    assert found.trajectories == 4
    clone = found.tried[0]
    assert clone.proximity == 0.0
    rewards = pb.trajectory(LION, 0.0, steps=100, seed=6)["reward"]
    # The second of its trajectories, by the sum that defines a return.
    weights = LOG.card.discount**rewards.index
    assert clone.returns[1] == pytest.approx(float((rewards * weights).sum()), rel=1e-9)


def test_any_system_will_do() -> None:
    found = pb.autopilot(
        LION, lambda p: -abs(p - 0.5), budget=40, margin=0.2, slope=1.0, noise=0.0, warm_up=1
    )
    assert found.proximity == 0.5
    assert all(one.mean >= -0.5 - 0.2 - 1e-9 for one in found.tried)


def test_what_it_cannot_do_is_said() -> None:
    with pytest.raises(ValueError, match="takes no proximity"):
        pb.autopilot(replace(LION, stack=LION.behaviour))
    with pytest.raises(ValueError, match="give margin and slope"):
        pb.autopilot(replace(LION, log=None))
    with pytest.raises(ValueError, match="no such setting"):
        pb.autopilot(LION, speed=3)
    with pytest.raises(ValueError, match="margin must be a positive"):
        pb.autopilot(LION, margin=0.0)
