"""The robots against Gymnasium's own, step by step; falls, failures, streams and refusals."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.utils.env_checker import check_env

from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.mujoco import simulations as engines
from components.environments.mujoco.robots import Robots
from components.environments.mujoco.specifications import (
    HOPPER,
    PHYSICS,
    ROBOTS,
    SWIMMER,
    WALKER2D,
    Robot,
    load_model,
    simulator_version,
)
from components.environments.systems import make_batch

BY_ID = {robot.id: robot for robot in ROBOTS.values()}
HALF_CHEETAH = Robot(
    title="HalfCheetah",
    gymnasium_class="gymnasium.envs.mujoco.half_cheetah_v5:HalfCheetahEnv",
    models=dict.fromkeys(PHYSICS, "half_cheetah.xml"),
    frame_features=tuple(f"observed_{n}" for n in range(17)),
    action_features=tuple(f"torque_{n}" for n in range(6)),
    velocity_limit=np.inf,
    control_cost=0.1,
    healthy_reward=0.0,
    health=None,
    reset_noise=0.1,
    normal_velocities=True,
    substeps=5,
)
"""One that nobody has registered: a record is all that it takes to simulate another robot."""
SIMULATED = {**BY_ID, HALF_CHEETAH.id: HALF_CHEETAH}
ASSETS = Path(gym.__file__).parent / "envs" / "mujoco" / "assets"
ENGINES = ["batched", "looped"]


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways of stepping MuJoCo; the second is what an older MuJoCo gets."""
    if request.param == "looped":
        monkeypatch.setattr(engines, "mujoco_batch", None)
    elif engines.mujoco_batch is None:
        pytest.skip("this MuJoCo has no mujoco.batch")
    return str(request.param)


class Reference:
    """One robot of Gymnasium, v5 as it is or with the corrections that restore v3."""

    def __init__(self, name: str, physics: str, folder: Path) -> None:
        self._v3 = physics == "v3"
        options: dict[str, Any] = {}
        if name == HOPPER.id and self._v3:
            text = (ASSETS / "hopper.xml").read_text(encoding="utf-8")
            halved = text.replace('margin="0.001"', 'margin="0.0005"')
            assert halved != text
            (folder / "hopper.xml").write_text(halved, encoding="utf-8")
            options["xml_file"] = str(folder / "hopper.xml")
        if name == WALKER2D.id and self._v3:
            options["xml_file"] = "walker2d.xml"
        original = name.split("/")[1].replace("-v0", "-v5")
        environment = gym.make(original, **options).unwrapped
        assert isinstance(environment, MujocoEnv)
        self._environment = environment

    def reset(self, seed: int | None = None) -> np.ndarray:
        return self._environment.reset(seed=seed)[0]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        frame, reward, terminated, _, info = self._environment.step(action)
        if terminated and self._v3:  # the healthy reward, in the order in which it is added
            assert info["reward_survive"] == 0.0
            reward = info["reward_forward"] + 1.0 + info["reward_ctrl"]
        return frame, float(reward), bool(terminated)


def uniform(rng: np.random.Generator, copies: int, robot: Robot) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (copies, len(robot.action_features)))


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")  # of the cheetah's file
@pytest.mark.parametrize("name", SIMULATED)
def test_every_copy_is_gymnasiums_robot_bit_by_bit(
    name: str, physics: str, engine: str, tmp_path: Path
) -> None:
    copies, seeds = 5, range(3, 8)
    robots = Robots(SIMULATED[name], copies, physics)
    generators = [np.random.default_rng(seed) for seed in seeds]
    singles = [Reference(name, physics, tmp_path) for _ in seeds]
    frames = robots.reset(generators)
    np.testing.assert_array_equal(frames, [s.reset(n) for s, n in zip(singles, seeds, strict=True)])
    rng, falls = np.random.default_rng(0), 0
    for _ in range(120):
        actions = uniform(rng, copies, SIMULATED[name])
        frames, rewards = robots.step(actions)
        alone = [single.step(action) for single, action in zip(singles, actions, strict=True)]
        np.testing.assert_array_equal(frames, [a[0] for a in alone])
        np.testing.assert_array_equal(rewards, [a[1] for a in alone])
        fallen = robots.terminated
        assert fallen.tolist() == [a[2] for a in alone]
        falls += int(fallen.sum())
        fresh = robots.reset_copies(fallen, generators)
        again = [singles[copy].reset() for copy in np.flatnonzero(fallen)]
        np.testing.assert_array_equal(fresh, np.reshape(again, fresh.shape))
        assert not robots.terminated.any()
    assert (falls == 0) == (SIMULATED[name].health is None)


@pytest.mark.filterwarnings("ignore:.*A Box observation space")  # Gymnasium's own are unbounded
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("name", BY_ID)
def test_the_single_environments_are_the_same_robots(
    name: str, physics: str, tmp_path: Path
) -> None:
    single, reference = gym.make(name, physics=physics), Reference(name, physics, tmp_path)
    check_env(single.unwrapped, skip_render_check=True)
    np.testing.assert_array_equal(single.reset(seed=2)[0], reference.reset(2))
    rng = np.random.default_rng(1)
    for step in range(1000):
        action = uniform(rng, 1, BY_ID[name])[0].astype(np.float32)
        frame, reward, terminated, truncated, _ = single.step(action)
        expected = reference.step(action)
        np.testing.assert_array_equal(frame, expected[0])
        assert (reward, terminated, truncated) == (*expected[1:], step == 999)
        if terminated:
            break
    assert terminated == (BY_ID[name].health is not None)
    twin = copy.deepcopy(single.unwrapped)  # Gymnasium's classes are copied by their arguments
    assert isinstance(twin, MujocoEnv)
    ours = load_model(BY_ID[name], physics)
    np.testing.assert_array_equal(twin.model.geom_margin, ours.geom_margin)
    np.testing.assert_array_equal(twin.model.geom_friction, ours.geom_friction)


def test_halved_margins_compile_to_the_model_of_a_file_that_has_them() -> None:
    text = (ASSETS / "hopper.xml").read_text(encoding="utf-8")
    written = mujoco.MjModel.from_xml_string(text.replace('margin="0.001"', 'margin="0.0005"'))
    plain = mujoco.MjModel.from_xml_string(text)

    def content(model: mujoco.MjModel) -> bytes:
        buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()

    assert content(load_model(HOPPER, "v3")) == content(written)
    assert content(load_model(HOPPER, "v5")) == content(plain)
    assert content(written) != content(plain)


def test_what_v3_changes_on_each_robot() -> None:
    def foot(physics: str) -> float:
        return float(load_model(WALKER2D, physics).geom("foot_geom").friction[0])

    assert (foot("v3"), foot("v5")) == (0.9, 1.9)
    for robot in (SWIMMER, WALKER2D):
        assert not load_model(robot, "v3").geom_margin.any()


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_every_value_has_a_name_of_its_own(robot: Robot) -> None:
    model, count = load_model(robot, "v3"), len(robot.frame_features)
    assert count == model.nq + model.nv - robot.unseen_positions
    assert len(robot.action_features) == model.nu
    assert len({*robot.frame_features, *robot.action_features}) == count + model.nu


@pytest.mark.parametrize("robot", [HOPPER, WALKER2D])
def test_names_of_features_follow_the_model(robot: Robot) -> None:
    model = load_model(robot, "v3")
    # MuJoCo calls the left leg's joints thigh_left_joint and the right one's thigh_joint
    for joint in range(3, model.njnt):
        part, *left = model.joint(joint).name.removesuffix("_joint").split("_")
        angle, torque = robot.frame_features[joint - 1], robot.action_features[joint - 3]
        for feature, quantity in ((angle, "angle"), (torque, "torque")):
            assert feature.endswith(f"{part}_{quantity}")
            assert feature.startswith("left") == (left == ["left"])
        turning = robot.frame_features[model.nq - 1 + joint]
        assert turning == angle.replace("angle", "angular_velocity")


@pytest.mark.parametrize("name", [HOPPER.id, WALKER2D.id])
def test_where_a_robot_stands_is_what_gymnasium_calls_healthy(name: str) -> None:
    single, health = gym.make(name).unwrapped, BY_ID[name].health
    assert isinstance(single, MujocoEnv)
    assert health is not None
    low, high = health.height
    at_bounds = [(1, low), (1, min(high, 50.0)), (2, health.angle), (2, -health.angle)]
    at_bounds += [(place, sign * 100.0) for place in (3, single.model.nq) for sign in (1, -1)]
    verdicts = []
    for place, bound in at_bounds:
        for value in (np.nextafter(bound, -np.inf), bound, np.nextafter(bound, np.inf), np.nan):
            state = np.concatenate([single.init_qpos, single.init_qvel])
            state[place] = value
            positions, velocities = np.split(state, [single.model.nq])
            single.data.qpos[:], single.data.qvel[:] = positions, velocities
            verdicts.append(bool(health.holds(positions[None], velocities[None])[0]))
            # Walker2D's class does not look at a joint's value, not even whether it is a number
            blind = name == WALKER2D.id and place > 2 and np.isnan(value)
            assert verdicts[-1] == (not blind and single.is_healthy)  # type: ignore[attr-defined]
    assert {True, False} == set(verdicts)


def fall(robots: Robots, rng: np.random.Generator) -> None:
    """Step until some copies have fallen and others stand."""
    for _ in range(100):
        robots.step(uniform(rng, robots.copies, HOPPER))
        if robots.terminated.any():
            break
    assert 0 < robots.terminated.sum() < robots.copies


def test_who_has_fallen_stays_down_and_disturbs_nobody(engine: str) -> None:
    left, restarted = Robots(HOPPER, 6), Robots(HOPPER, 6)
    for robots in (left, restarted):
        robots.reset(np.random.default_rng(4))
        fall(robots, np.random.default_rng(5))
    down = left.terminated
    restarted.reset_copies(down, np.random.default_rng(6))
    frames, _ = left.step(np.zeros((6, 3)))
    restarted.step(np.zeros((6, 3)))
    for actions in np.random.default_rng(7).uniform(-1.0, 1.0, (5, 6, 3)):
        later, rewards = left.step(actions)
        beside, earned = restarted.step(actions)
        assert left.terminated[down].all()
        np.testing.assert_array_equal(later[down], frames[down])
        assert not rewards[down].any()
        np.testing.assert_array_equal(later[~down], beside[~down])
        np.testing.assert_array_equal(rewards[~down], earned[~down])
        assert earned[down].all()  # who was started again is simulated


def test_a_fall_of_all_is_survived_by_a_reset(engine: str) -> None:
    robots = Robots(HOPPER, 2)
    robots.reset(np.random.default_rng(0))
    for _ in range(100):
        robots.step(np.ones((2, 3)))
    assert robots.terminated.all()
    robots.reset(np.random.default_rng(1))
    frames, rewards = robots.step(np.zeros((2, 3)))
    assert not robots.terminated.any()
    assert rewards.all()
    expected = Robots(HOPPER, 2)
    expected.reset(np.random.default_rng(1))
    np.testing.assert_array_equal(frames, expected.step(np.zeros((2, 3)))[0])


def test_an_unstable_simulation_counts_as_a_fall(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    robots, calm = Robots(SWIMMER, 3), Robots(SWIMMER, 3)
    for each in (robots, calm):
        each.reset(np.random.default_rng(0))
    middle = np.array([1])
    robots._simulations.start(middle, np.full((1, 5), 3.0), np.full((1, 5), 1e12))
    actions = np.full((3, 2), 0.5)
    frames, rewards = robots.step(actions)
    expected, earned = calm.step(actions)
    assert robots.terminated.tolist() == [False, True, False]
    assert np.isfinite(frames).all()
    assert rewards[1] == -1e-4 * 0.5  # no forward speed, the control cost alone
    np.testing.assert_array_equal(frames[[0, 2]], expected[[0, 2]])
    np.testing.assert_array_equal(rewards[[0, 2]], earned[[0, 2]])
    robots.reset_copies(robots.terminated, np.random.default_rng(1))
    robots.step(actions)
    assert not robots.terminated.any()


@pytest.mark.parametrize("name", BY_ID)
def test_numbers_do_not_depend_on_threads_or_on_how_many_copies_there_are(
    name: str, engine: str
) -> None:
    many, few = make_batch(name, 70, threads=2), make_batch(name, 2)
    first = many.reset(np.random.default_rng(3))
    # one generator serves copy after copy
    np.testing.assert_array_equal(first[:2], few.reset(np.random.default_rng(3)))
    for actions in np.random.default_rng(8).uniform(-1.0, 1.0, (10, 70, len(many.action_features))):
        frames, rewards = many.step(actions)
        alone, earned = few.step(actions[:2])
        np.testing.assert_array_equal(frames[:2], alone)
        np.testing.assert_array_equal(rewards[:2], earned)


def test_actions_are_clipped() -> None:
    wild, tame = Robots(WALKER2D, 2), Robots(WALKER2D, 2)
    for robots in (wild, tame):
        robots.reset(np.random.default_rng(0))
    actions = np.tile([[7.0, -7.0, 1.5, 0.2, -0.2, 0.0]], (2, 1))
    for got, expected in zip(wild.step(actions), tame.step(np.clip(actions, -1, 1)), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_results_belong_to_the_caller(engine: str) -> None:
    robots = Robots(HOPPER, 2)
    first = robots.reset(np.random.default_rng(0))
    frames, rewards = robots.step(np.zeros((2, 3)))
    kept = [first.copy(), frames.copy(), rewards.copy()]
    before = robots.terminated
    for _ in range(100):
        robots.step(np.ones((2, 3)))
    assert robots.terminated.all()
    assert not before.any()
    for array, expected in zip((first, frames, rewards), kept, strict=True):
        np.testing.assert_array_equal(array, expected)


def hopper(copies: int = 2, **parameters: Any) -> Robots:
    robots = Robots(HOPPER, copies, **parameters)
    robots.reset(np.random.default_rng(0))
    return robots


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (
            lambda: make_batch("Hopper-v5", 2),
            "Unknown environment 'Hopper-v5'; known are ",
        ),
        (lambda: make_batch(HOPPER.id, 2, physics="v4"), "physics 'v4' does not exist; choose v3"),
        (
            lambda: gym.make(SWIMMER.id, physics="v2"),
            "physics 'v2' does not exist; choose v3 or",
        ),
        (lambda: hopper(0), "copies is 0 and threads is 1; give at least 1"),
        (lambda: hopper(threads=0), "copies is 2 and threads is 0; give at least 1"),
        (lambda: hopper().step(np.zeros((2, 6))), r"the shape \(2, 6\); 2 copies need \(2, 3\)"),
        (lambda: hopper().step(np.zeros(3)), r"the shape \(3,\); 2 copies need \(2, 3\)"),
        (lambda: hopper().step(np.full((2, 3), np.nan)), "not a number; the copies did not move"),
        (lambda: Robots(HOPPER, 2).step(np.zeros((2, 3))), "step was called before reset"),
        (lambda: hopper().reset([np.random.default_rng(0)] * 3), "3 generators .* for 2 copies"),
    ],
)
def test_refusals_say_what_is_wrong(attempt: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        attempt()


def test_every_batch_names_its_features_and_who_has_ended() -> None:
    for name in (*BY_ID, INDUSTRIAL_BENCHMARK_ID):
        environment = make_batch(name, 3)
        frames = environment.reset(np.random.default_rng(0))
        assert frames.shape == (3, len(environment.frame_features))
        environment.step(np.zeros((3, len(environment.action_features))))
        assert environment.terminated.tolist() == [False] * 3
        mask = np.array([True, False, True])
        fresh = environment.reset_copies(mask, np.random.default_rng(1))
        assert fresh.shape == (2, frames.shape[1])


def test_version_of_the_simulator() -> None:
    assert simulator_version() == f"mujoco {mujoco.mj_versionString()}"
