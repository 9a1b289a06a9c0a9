"""Robot datasets: exploration, ends of episodes, order, cards, and what returns count."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from components.core.random_streams import lane_generator, lane_key
from components.data.batches import LaneData
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.data.sources import robots
from components.data.sources.robot_collection import Exploration, collect_episodes
from components.data.sources.robots import RobotSpec
from components.environments.mujoco import robots as mujoco_robots
from components.environments.mujoco.robots import Robots
from components.environments.mujoco.specifications import HOPPER, ROBOTS, SWIMMER, WALKER2D, Robot
from tests.components.data.sources.toy_robot import FEATURES, LIMIT, ToyRobot, toy_expert

SPEC = RobotSpec("toy", "hopper", transitions=3000, steps=120)


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Hopper's place taken by the toy; the folder of its expert."""
    (tmp_path / "hopper").mkdir()
    toy_expert().save(tmp_path / "hopper")
    monkeypatch.setattr(robots, "SHIPPED", tmp_path)
    shown = {"frame_features": FEATURES, "action_features": ToyRobot.action_features}
    hopper = dataclasses.replace(HOPPER, health=None, **shown)
    monkeypatch.setattr(robots, "ROBOTS", ROBOTS | {"hopper": hopper})
    monkeypatch.setattr(mujoco_robots, "Robots", lambda robot, copies, *_: ToyRobot(copies))
    return tmp_path / "hopper"


@pytest.fixture
def dataset(toy: Path) -> OfflineDataset:
    return SPEC.generate(0)


def lengths(dataset: OfflineDataset) -> np.ndarray:
    return np.diff(dataset.episode_starts)


def test_the_three_of_the_thesis() -> None:
    for name in ("swimmer", "hopper", "walker2d"):
        assert name in ROBOTS
        spec = RobotSpec(name, name)
        assert spec.physics == "v3"
        assert (spec.epsilon, spec.noise, spec.discount) == (0.3, 0.3, 0.99)
        assert (spec.transitions, spec.steps) == (1_000_000, 1000)


def test_rows_pair_frames_actions_and_rewards(dataset: OfflineDataset) -> None:
    rows = dataset.frame_rows()
    machine = ToyRobot(dataset.transitions)
    machine._state = dataset.frames[rows].astype(np.float64)
    frames, rewards = machine.step(dataset.actions.astype(np.float64))
    # float32 frames
    np.testing.assert_allclose(dataset.frames[rows + 1], frames, atol=1e-5)
    np.testing.assert_allclose(dataset.rewards, rewards, atol=1e-5)
    starts = dataset.frames[dataset.first_rows()[dataset.episode_starts[:-1]]]
    assert np.abs(starts).max() <= 0.1
    assert len(np.unique(starts)) == starts.size


def test_episodes_end_by_falls_or_by_time_and_the_last_one_by_the_budget(toy: Path) -> None:
    spec = dataclasses.replace(SPEC, steps=12, epsilon=0.8)
    dataset = spec.generate(0)
    last = dataset.episode_starts[1:] - 1
    fallen = np.abs(dataset.frames[dataset.frame_rows() + 1, 2]) > LIMIT
    np.testing.assert_array_equal(dataset.terminated, fallen)
    ends = dataset.terminated | dataset.truncated
    np.testing.assert_array_equal(np.flatnonzero(ends), last)
    assert not (dataset.terminated & dataset.truncated).any()
    assert dataset.transitions == spec.transitions
    assert (lengths(dataset)[:-1][dataset.truncated[last[:-1]]] == 12).all()
    assert 0 < dataset.terminated.sum() < dataset.episodes - 1
    assert lengths(dataset).max() == 12
    data = LaneData([dataset], torch.device("cpu"))
    continues = data.batch(torch.arange(dataset.transitions)[None]).continues[0].numpy()
    np.testing.assert_array_equal(continues == 0.0, dataset.terminated)


def test_a_budget_that_cuts_an_episode_makes_no_fall(toy: Path) -> None:
    whole = SPEC.generate(0)
    ends = lengths(whole)[0] - 1
    cut = dataclasses.replace(SPEC, transitions=int(ends)).generate(0)
    assert (cut.episodes, cut.transitions) == (1, ends)
    assert not cut.terminated.any()
    assert np.flatnonzero(cut.truncated).tolist() == [ends - 1]
    np.testing.assert_array_equal(cut.frames, whole.frames[: ends + 1])
    assert cut.card.return_steps == min(100, ends)


def plans(spec: RobotSpec, episodes: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The exploration of every episode of a dataset of seed 0, by the episode's number alone."""
    key = lane_key(lane_key("robot dataset", spec.name, 0), "exploration")
    drawn = Exploration(spec.epsilon, spec.noise)
    return [drawn.plan(lane_generator(key, n), spec.steps, 2) for n in range(episodes)]


def test_actions_are_the_experts_with_noise_or_uniform(toy: Path) -> None:
    spec = dataclasses.replace(SPEC, transitions=20_000)
    dataset = spec.generate(0)
    wanted = toy_expert().act(dataset.frames[dataset.frame_rows()].astype(np.float64))
    rows = np.arange(dataset.transitions) - np.repeat(dataset.episode_starts[:-1], lengths(dataset))
    planned = plans(spec, dataset.episodes)
    uniform, noise = (
        np.stack([planned[e][part][t] for e, t in zip(dataset.episode_index(), rows, strict=True)])
        for part in (0, 1)
    )
    explored = ~np.isnan(uniform[:, 0])
    np.testing.assert_array_equal(dataset.actions[explored], uniform[explored].astype(np.float32))
    noisy = wanted[~explored] + noise[~explored]
    assert (np.abs(noisy) > 1.0).any()
    # the expert saw the frames before they were rounded to float32
    np.testing.assert_allclose(dataset.actions[~explored], noisy.clip(-1.0, 1.0), atol=1e-5)
    # five standard errors each: together a false alarm in 300,000 seeds
    assert explored.mean() == pytest.approx(0.3, abs=5 * (0.21 / 20_000) ** 0.5)
    entries = uniform[explored].size
    assert uniform[explored].mean() == pytest.approx(0.0, abs=5 * 0.577 / entries**0.5)
    assert uniform[explored].var() == pytest.approx(1 / 3, abs=5 * 0.298 / entries**0.5)
    entries = noise[~explored].size
    assert noise[~explored].mean() == pytest.approx(0.0, abs=5 * 0.3 / entries**0.5)
    assert noise[~explored].std() == pytest.approx(0.3, rel=5 / (2 * entries) ** 0.5)


def test_the_log_does_not_depend_on_the_number_of_copies() -> None:
    def log(copies: int, transitions: int = 700) -> list:
        return collect_episodes(
            toy_expert().act,
            ToyRobot(copies),
            Exploration(0.5, 0.3),
            horizon=40,
            transitions=transitions,
            key=7,
        )

    alone = log(1)
    assert len({episode.steps for episode in alone}) > 3
    for copies in (2, 9, 50):
        together = log(copies)
        assert len(together) == len(alone)
        for one, two in zip(alone, together, strict=True):
            assert one.terminated == two.terminated
            for name in ("frames", "actions", "rewards"):
                # the expert acts in double precision, so float32 actions are the same
                np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    longer = log(9, 1400)
    for one, two in zip(alone[:-1], longer, strict=False):
        np.testing.assert_array_equal(one.frames, two.frames)


def test_bytes_depend_on_name_seed_and_expert_alone(toy: Path, dataset: OfflineDataset) -> None:
    np.random.seed(7)  # noqa: NPY002 - the global state must not matter
    assert SPEC.generate(0).card == dataset.card
    digests = {
        dataset.card.digest,
        SPEC.generate(1).card.digest,
        dataclasses.replace(SPEC, name="another").generate(0).card.digest,
    }
    assert len(digests) == 3
    toy_expert(scale=0.5).save(toy)
    other = SPEC.generate(0).card
    assert other.digest not in digests
    assert other.controller_digest != dataset.card.controller_digest
    assert SPEC.ingredients == {"expert": other.controller_digest}


def test_card_says_what_the_log_is(dataset: OfflineDataset) -> None:
    card = dataset.card
    assert (card.controller, card.epsilon, card.noise) == ("expert", 0.3, 0.3)
    assert (card.environment, card.environment_parameters) == (
        "proximity/Hopper-v0",
        {"physics": "v3"},
    )
    assert (card.transitions, card.trajectories) == (3000, dataset.episodes)
    assert card.steps == lengths(dataset).max()
    assert (card.history, card.discount, card.return_steps) == (1, 0.99, 100)
    assert card.simulator.startswith("mujoco 4") or card.simulator.startswith("mujoco 3")
    assert card.dynamics == robots.ROBOTS["hopper"].dynamics
    assert DatasetCard.from_json(card.to_json()) == card


def test_of_a_robot_only_its_action_is_known() -> None:
    section = SWIMMER.dynamics
    assert section["known"] == {
        "features": ["first_rotor_torque", "second_rotor_torque"],
        "keep": [0.0, 0.0],
        "scale": [1.0, 1.0],
        "low": -1.0,
        "high": 1.0,
    }
    assert section["learned"] == [*SWIMMER.frame_features, "reward"]
    assert section["reward"] == {"reward": 1.0}
    assert "healthy" not in section


@pytest.mark.parametrize("robot", [HOPPER, WALKER2D])
def test_healthy_ranges_tell_falls_from_frames(robot: Robot) -> None:
    machine = Robots(robot, 60)
    rng = np.random.default_rng(0)
    machine.reset(rng)
    ranges = robot.dynamics["healthy"]
    everything = [ranges.get(name, [None, None]) for name in robot.frame_features]
    low = np.array([-np.inf if least is None else least for least, _ in everything])
    high = np.array([np.inf if greatest is None else greatest for _, greatest in everything])
    for _ in range(60):
        frames, _ = machine.step(rng.uniform(-1.0, 1.0, (60, len(robot.action_features))))
        stands = ((low < frames) & (frames < high)).all(axis=1)
        np.testing.assert_array_equal(stands, ~machine.terminated)
    assert machine.terminated.any()


def test_returns_on_the_card_count_nothing_after_a_fall(dataset: OfflineDataset) -> None:
    first = []
    for begin, end in zip(dataset.episode_starts[:-1], dataset.episode_starts[1:], strict=True):
        lived = dataset.rewards[begin : min(end, begin + 100)].astype(np.float64)
        if dataset.terminated[end - 1] or len(lived) == 100:
            first.append((0.99 ** np.arange(len(lived))) @ lived)
    assert len(first) in (dataset.episodes, dataset.episodes - 1)
    card = dataset.card
    assert card.first_window_return_mean == pytest.approx(np.mean(first))
    assert card.first_window_return_min == pytest.approx(np.min(first))
    assert card.first_window_return_max == pytest.approx(np.max(first))


def test_storage_round_trip(dataset: OfflineDataset, tmp_path: Path) -> None:
    dataset.write(tmp_path / "stored")
    opened = OfflineDataset.open(tmp_path / "stored")
    assert opened.card == dataset.card
    for name, array in dataset.arrays().items():
        np.testing.assert_array_equal(opened.arrays()[name], array)


def test_an_expert_of_another_robot_is_refused(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(ToyRobot):
        frame_features = ("place", "speed", "angle")

    monkeypatch.setattr(mujoco_robots, "Robots", lambda robot, copies, *_: Other(copies))
    with pytest.raises(ValueError, match="does not know the frames of proximity/Hopper-v0"):
        SPEC.generate(0)


def test_a_missing_expert_is_named(toy: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no expert in .*swimmer.*flows\.train_experts"):
        RobotSpec("swimmer", "swimmer").generate(0)


def test_the_log_of_a_swimmer_can_be_played_again(monkeypatch: pytest.MonkeyPatch) -> None:
    expert = toy_expert(features=SWIMMER.frame_features)
    monkeypatch.setattr(RobotSpec, "_expert", lambda self: expert)
    dataset = RobotSpec("swimmer", "swimmer", transitions=150, steps=60).generate(0)
    assert lengths(dataset).tolist() == [60, 60, 30]
    # the logged actions, played from the logged start, earn the logged rewards
    machine = Robots(SWIMMER, 3, "v3")
    key = lane_key("robot dataset", "swimmer", 0)
    frames = machine.reset([lane_generator(lane_key(key, "start"), n) for n in range(3)])
    rows = dataset.episode_starts[:-1]
    for t in range(30):
        stored = dataset.frames[rows + np.arange(3) + t]
        np.testing.assert_array_equal(frames.astype(np.float32), stored)
        frames, rewards = machine.step(dataset.actions[rows + t].astype(np.float64))
        np.testing.assert_array_equal(rewards.astype(np.float32), dataset.rewards[rows + t])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "walker"}, "known are swimmer, hopper, walker2d"),
        ({"physics": "v4"}, "known are v3, v5"),
        ({"epsilon": 1.5}, "from 0 to 1"),
        ({"noise": -0.1}, "from 0"),
        ({"transitions": 0}, "at least 1"),
        ({"discount": 0.0}, "above 0"),
    ],
)
def test_impossible_specifications_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SPEC, **change)


def test_an_expert_of_the_other_physics_is_refused() -> None:
    spec = RobotSpec("swimmer", "swimmer", transitions=9, physics="v5")
    for use in (lambda: spec.ingredients, lambda: spec.generate(0)):
        with pytest.raises(ValueError, match="in the physics v3, not v5; train one with"):
            use()


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow(2)
def test_shipped_experts_log_the_same_bytes_on_more_threads(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robots, "_COPIES", 5)  # not 100, which would live 100,000 steps
    spec = RobotSpec(robot, robot, transitions=2000)
    digests = {spec.generate(0, threads).card.digest for threads in (1, 2)}
    assert len(digests) == 1
