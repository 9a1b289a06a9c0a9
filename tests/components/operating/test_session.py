"""Sessions: both copies begin alike, differ by what is done to them alone, and warn."""

import dataclasses

import numpy as np
import pytest

from components.evaluation.guarantee import Guarantee
from components.operating.flying import Flying
from components.operating.operable import SHIPPED, Operable
from components.operating.session import Session
from tests.components.operating.machines import LOG, TURBINE, recorded, turbine, turned
from tests.components.synthetic import constant_policy


def test_the_policy_acts_at_the_proximity_that_is_set() -> None:
    session = Session(turbine())
    for proximity in (0.0, 0.3, 1.0):
        session.proximity = proximity
        done = session.step()
        # float32 in the policy
        np.testing.assert_allclose(done.actions[0], turned(proximity), atol=1e-6)
        np.testing.assert_array_equal(done.actions[1], 0.0)
        assert done.proximity == proximity
        assert done.distance == pytest.approx(np.sqrt(3) * abs(turned(proximity)), abs=1e-6)


def test_both_copies_are_the_same_machine_while_the_same_is_done() -> None:
    session = Session(turbine(constant_policy([0.0, 0.0, 0.0])), seed=3)
    for _ in range(8):
        done = session.step()
        np.testing.assert_array_equal(session.frames[0], session.frames[1])
        assert done.rewards[0] == done.rewards[1]
    assert session.sums[0] != 0


def test_the_behaviour_beside_it_does_not_feel_the_operator() -> None:
    left, right = Session(turbine(), seed=1), Session(turbine(), seed=1)
    right.proximity = 1.0
    for _ in range(8):
        a, b = left.step(), right.step()
        assert a.rewards[1] == b.rewards[1]
        np.testing.assert_array_equal(left.frames[1], right.frames[1])
    assert not np.array_equal(left.frames[0], right.frames[0])


def test_the_behaviour_can_drive_and_nobody_unknown() -> None:
    session = Session(turbine())
    session.proximity = 1.0
    session.driver = "behaviour"
    done = session.step()
    np.testing.assert_array_equal(done.actions[0], done.actions[1])
    assert done.distance == 0
    assert session.drivers == ("operator", "behaviour")
    for name in ("autopilot", "../../etc/passwd"):
        with pytest.raises(ValueError, match="known are operator, behaviour"):
            session.driver = name  # type: ignore[assignment]


class Upwards:
    """A pilot of trajectories of three steps, each at a greater proximity."""

    def __init__(self) -> None:
        self.heard: list[float] = []
        self.forgotten = 0

    @property
    def landed(self) -> bool:
        return len(self.heard) % 3 == 0

    def propose(self) -> float:
        return 0.25 * (len(self.heard) // 3)

    def tell(self, reward: float) -> None:
        self.heard.append(reward)

    def ended(self) -> None:
        raise AssertionError("no episode is so short")

    def forget(self) -> None:
        self.forgotten += 1


def test_a_pilot_chooses_the_proximity_and_flies_each_trajectory_from_a_fresh_start() -> None:
    pilot = Upwards()
    session = Session(turbine(), pilot=pilot)
    session.step()
    assert pilot.heard == []  # it hears nothing while somebody else drives
    session.driver = "autopilot"
    steps = [session.step() for _ in range(7)]
    assert [step.proximity for step in steps] == [0.0] * 3 + [0.25] * 3 + [0.5]
    assert [step.step for step in steps] == [0, 1, 2, 0, 1, 2, 0]
    assert pilot.heard == [step.rewards[0] for step in steps]
    assert pilot.forgotten == 1


def test_the_autopilot_measures_the_familiar_first_and_goes_no_farther_than_is_safe() -> None:
    card = dataclasses.replace(TURBINE, return_steps=4, first_window_return_mean=-8.0)
    machine = dataclasses.replace(turbine(constant_policy([0.0] * 3)), card=card)
    pilot = Flying(card)
    session = Session(dataclasses.replace(turbine(), card=card), pilot=pilot)
    session.driver = "autopilot"
    flown = [session.step() for _ in range(4 * 8)]
    assert {step.proximity for step in flown} == {0.0}  # the warm-up of eight trajectories
    assert {step.episode for step in flown} == set(range(1, 9))
    assert "trajectory 9 of 60" in pilot.said
    ahead = session.step()
    assert ahead.proximity <= 0.05
    assert Session(machine, pilot=Flying(card)).drivers == ("operator", "behaviour")
    while "stays at" not in pilot.said:
        session.step()
    found = session.step().proximity
    assert 0 <= found <= 1


def test_the_guarantee_decides_how_far_the_autopilot_goes_and_what_it_promises() -> None:
    """On noiseless returns a slope of 40 times the return lets it go a tenth as far as one of 4."""
    card = dataclasses.replace(TURBINE, return_steps=1, steps=1, first_window_return_mean=-10.0)
    ahead = []
    for slope in (4.0, 40.0):
        pilot = Flying(card, Guarantee(margin=0.1, slope=slope))
        for _ in range(8):
            assert pilot.propose() == 0.0
            pilot.tell(-10.0)
        ahead.append(pilot.propose())
    assert ahead[0] == pytest.approx(0.025)  # margin / slope
    assert ahead[1] == 0.0  # shorter than the resolution of 0.01
    assert "more than 1 below the behaviour's" in pilot.promise
    assert "falls by at most 4e+02 per unit of λ" in pilot.promise
    for wrong in ({"margin": 0.0}, {"slope": float("nan")}):
        with pytest.raises(ValueError, match="must be a positive number"):
            Guarantee(**wrong)


@pytest.mark.parametrize("value", [-0.01, 1.01, float("nan"), float("inf")])
def test_a_proximity_out_of_range_is_refused(value: float) -> None:
    session = Session(turbine())
    session.proximity = 0.4
    with pytest.raises(ValueError, match="must lie in"):
        session.proximity = value
    assert session.proximity == 0.4


def test_an_episode_ends_at_its_horizon_and_the_next_has_another_noise() -> None:
    session = Session(turbine())
    first = [session.step() for _ in range(TURBINE.steps)]
    assert session.over
    second = [session.step() for _ in range(TURBINE.steps)]
    assert [s.step for s in second] == list(range(TURBINE.steps))
    assert {s.episode for s in first} == {0}
    assert {s.episode for s in second} == {1}
    assert [s.rewards[0] for s in first] != [s.rewards[0] for s in second]


def test_another_setpoint_is_demanded_at_once_and_is_strange_to_the_log() -> None:
    session = Session(turbine(constant_policy([0.0, 0.0, 0.0])))
    twin = Session(turbine(constant_policy([0.0, 0.0, 0.0])))
    session.step(), twin.step()
    session.plant.demand(40.0)
    for _ in range(4):
        done, other = session.step(), twin.step()
    assert (done.setpoint, other.setpoint) == (40.0, 70.0)
    assert session.frames[0, 0] == 40.0
    assert done.rewards[0] != other.rewards[0]
    assert done.strangeness > 1
    assert session.strayed
    session.restart()
    assert session.frames[0, 0] == 40.0  # what is demanded stays
    with pytest.raises(ValueError, match="from 0 to 100"):
        session.plant.demand(101.0)


def test_a_change_of_the_setpoint_is_a_machine_of_that_setpoint() -> None:
    """The equations of a running machine after a change are those of one that was built so."""
    changed = Session(turbine())
    changed.plant.demand(40.0)
    changed.restart()
    card = dataclasses.replace(TURBINE, environment_parameters={"setpoint": 40.0})
    built = Session(dataclasses.replace(turbine(), card=card))
    built.restart()
    for _ in range(5):
        assert changed.step().rewards.tolist() == built.step().rewards.tolist()


def test_the_state_strays_only_after_several_strange_steps() -> None:
    session = Session(turbine(constant_policy([0.99, 0.99, 0.99])))
    strange, warned = [], []
    for _ in range(TURBINE.steps):
        strange.append(session.step().strangeness > 1)
        warned.append(session.strayed)
    for step in range(TURBINE.steps):
        assert warned[step] == (step >= 2 and all(strange[step - 2 : step + 1]))


def test_recorded_states_are_shown_as_they_were_logged() -> None:
    session = Session(recorded())
    session.proximity = 0.7
    steps = [session.step() for _ in range(40)]  # an episode of 30, and ten of the next
    np.testing.assert_allclose([s.frames[0] for s in steps[:30]], LOG.frames[:30])
    np.testing.assert_allclose([s.frames[0] for s in steps[30:]], LOG.frames[31:41])
    np.testing.assert_allclose([s.actions[1] for s in steps], LOG.actions[:40])
    np.testing.assert_allclose([s.rewards[0] for s in steps], LOG.rewards[:40])
    np.testing.assert_allclose([s.actions[0] for s in steps], turned(0.7), atol=1e-6)
    with pytest.raises(ValueError, match="no setpoint"):
        session.plant.demand(1.0)


def test_there_must_be_a_system_or_a_log_of_the_policys_frames() -> None:
    with pytest.raises(ValueError, match="names no registered system"):
        Session(dataclasses.replace(recorded(), log=None))
    other = constant_policy([0.0], features=("x",), history=1)
    with pytest.raises(ValueError, match="does not show"):
        Session(dataclasses.replace(turbine(other), behaviour=None))


def test_a_policy_without_numbers_does_not_stop_the_machine() -> None:
    sick = constant_policy([0.0, 0.0, 0.0])
    sick.layers[0][1].fill_(float("nan"))
    session = Session(turbine(sick))
    np.testing.assert_array_equal(session.step().actions[0], 0.0)


@pytest.mark.parametrize("name", ["world", "turbine"])
def test_turning_a_shipped_policy_is_worth_it(name: str) -> None:
    """At its best proximity it earns more than the behaviour beside it, step by step.

    Measured over these seeds the margins are several times those asked for.
    """
    session = Session(Operable.load(SHIPPED / name), seed=5)
    familiar, better = [], []
    best, steps, margin = {"world": (1.0, 250, 0.4), "turbine": (0.3, 300, 0.02)}[name]
    for proximity, gains in ((0.0, familiar), (best, better)):
        session.restart()
        session.proximity = proximity
        for _ in range(steps):
            rewards = session.step().rewards
            gains.append(rewards[0] - rewards[1])
    assert np.mean(better) > margin
    assert abs(np.mean(familiar)) < np.mean(better)
