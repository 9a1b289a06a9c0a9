"""What cards say of machines, and machine frames put together by hand."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from components.data.batches import LaneData
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from tests.components.robot import make_robot_log
from tests.components.synthetic import CPU, FEATURES, SCALE, make_log

LOG, ROBOT = make_log(), make_robot_log()


def changed(log: OfflineDataset, **section: Any) -> OfflineDataset:
    """The log with parts of its card's machine section replaced."""
    dynamics = {**log.card.dynamics, **section}
    return dataclasses.replace(log, card=dataclasses.replace(log.card, dynamics=dynamics))


def frames_by_loop(log: OfflineDataset) -> np.ndarray:
    """Action before, state, reward with it; zeros where an episode begins."""
    rows: list[np.ndarray] = []
    for start, end in zip(log.episode_starts[:-1], log.episode_starts[1:], strict=True):
        rows.append(np.concatenate([np.zeros(2), log.frames[len(rows)], [0.0]]))
        for n in range(start, end):
            state = log.frames[len(rows)]
            rows.append(np.concatenate([log.actions[n], state, [log.rewards[n]]]))
    return np.stack(rows)


def test_a_machine_that_shows_its_steerings() -> None:
    rule = DynamicsSpecification.of_card(LOG.card)
    assert rule.features == FEATURES
    assert (rule.keep, rule.scale, rule.low, rule.high) == ((1, 1, 1), tuple(SCALE), 0.0, 100.0)
    assert rule.reward == (-0.03, -0.01)
    assert not rule.hides
    assert rule.shown == (True, True)
    assert model_frames(LOG, rule) is LOG.frames


def test_a_robot_of_which_nothing_is_known_but_the_action() -> None:
    rule = DynamicsSpecification.of_card(ROBOT.card)
    assert rule.known == ("hip", "knee")
    assert rule.learned == ("tilt", "speed", "bend", "reward")
    assert (rule.keep, rule.scale, rule.low, rule.high) == ((0, 0), (1, 1), -1.0, 1.0)
    assert rule.reward == (0, 0, 0, 1)
    assert rule.hides
    assert rule.observed == (2, 5)
    assert rule.shown == (True, True, True, False)
    found = model_frames(ROBOT, rule)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, frames_by_loop(ROBOT).astype(np.float32))


def test_rules_survive_the_card_s_json() -> None:
    for log in (LOG, ROBOT):
        again = DatasetCard.from_json(log.card.to_json())
        assert DynamicsSpecification.of_card(again) == DynamicsSpecification.of_card(log.card)


def test_the_industrial_benchmark_s_card_tells_how_its_frames_follow_from_actions() -> None:
    log = generate(IndustrialSpec("bad-0.4", "bad", 0.4, trajectories=2, steps=50), seed=0)
    rule = DynamicsSpecification.of_card(log.card)
    assert not rule.hides
    before, after = log.frames[log.frame_rows()], log.frames[log.frame_rows() + 1]
    moved = np.clip(before[:, 1:4] + np.array(rule.scale) * log.actions, rule.low, rule.high)
    # frames are logged in single precision
    np.testing.assert_allclose(after[:, 1:4], moved, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(after[:, 4:] @ np.array(rule.reward), log.rewards, rtol=1e-5)


@pytest.mark.parametrize("frames", [1, 3])
def test_what_is_recorded_up_to_a_state(frames: int) -> None:
    """Of two lanes with unequal episodes, before which their first frame is repeated."""
    logs = [ROBOT, make_robot_log("other", seed=5, episodes=7)]
    data = LaneData(logs, CPU)
    last = logs[1].transitions - 1
    index = torch.tensor([[0, 1, 2, int(ROBOT.episode_starts[3]), 60], [0, 5, 1, last, 70]])
    seen, recorded = data.start_states(index, frames)
    assert torch.equal(seen, data.observations(index))
    history = data.raw_histories(index)
    assert history.shape == (2, 5, 1, 3)
    assert recorded.shape == (2, 5, frames, 6)
    for lane, log in enumerate(logs):
        whole = frames_by_loop(log)
        for b, n in enumerate(index[lane].tolist()):
            newest, first = log.frame_rows()[n], log.first_rows()[n]
            np.testing.assert_array_equal(history[lane, b, 0], log.frames[newest])
            for lag in range(frames):
                expected = whole[max(newest - lag, first)].astype(np.float32)
                np.testing.assert_array_equal(recorded[lane, b, lag], expected)


def test_where_policies_see_all_the_past_is_what_they_see() -> None:
    data = LaneData([LOG], CPU)
    index = torch.tensor([[0, 41, 100]])
    seen, recorded = data.start_states(index, 2)
    assert torch.equal(seen, data.observations(index))
    assert torch.equal(recorded, data.raw_histories(index))
    for b, n in enumerate(index[0].tolist()):
        newest, first = LOG.frame_rows()[n], LOG.first_rows()[n]
        for lag in range(LOG.card.history):
            # the frames themselves, not scaled and back
            expected = LOG.frames[max(newest - lag, first)]
            np.testing.assert_array_equal(recorded[0, b, lag], expected)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"known": {"features": ["hip", "knee"]}}, "lacks 'keep' in its dynamics specification"),
        ({"learned": ["tilt", "bend", "speed", "reward"]}, "needs frames of .* but robot logs"),
        ({"learned": ["tilt", "speed", "bend", "height"]}, "needs frames of .* but robot logs"),
        ({"reward": {"profit": 1.0}}, "the reward {'profit': 1.0} must be made of"),
        (
            {"known": {**ROBOT.card.dynamics["known"], "features": ["knee", "hip"]}},
            r"must end with the actions \('hip', 'knee'\)",
        ),
        ({"known": {**ROBOT.card.dynamics["known"], "keep": [0.0]}}, "a number for each"),
    ],
)
def test_cards_that_contradict_their_logs_are_refused(section: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DynamicsSpecification.of_card(changed(ROBOT, **section).card)
