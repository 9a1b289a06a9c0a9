"""The search on an expert's output layer: by plain code, its result, its resumption."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.core.random_streams import lane_generator, lane_key
from components.data.controllers.trained.shipped import act_in_double
from components.experts.episodes import episode_rewards
from components.experts.refinement import OutputSearch, RefinementConfig, refine
from components.policies.policy import Policy
from tests.components.data.sources.toy_robot import ToyRobot, toy_expert
from tests.components.interruption import killed_at

TINY = RefinementConfig(iterations=6, directions=4, components=3, evaluate_every=2, episodes=5)
HORIZON = 15


def made(config: RefinementConfig = TINY) -> OutputSearch:
    return OutputSearch(config, 7, toy_expert().policy, ToyRobot, HORIZON)


def returns(policy: Policy, starts: list[np.random.Generator]) -> np.ndarray:
    robots = ToyRobot(len(starts))
    return episode_rewards(partial(act_in_double, policy), robots, starts, HORIZON).sum(axis=1)


def test_it_begins_as_the_expert_and_evaluates_what_it_returns() -> None:
    search = made()
    frames = np.random.default_rng(0).normal(size=(9, 3))
    expert = toy_expert()
    np.testing.assert_allclose(search._act(frames, search._theta), expert.act(frames), atol=1e-12)
    search._theta = np.random.default_rng(1).normal(size=search._theta.shape)
    reached = search.evaluate(4)
    policy, best, step = search.best
    assert (best, step, policy.card.steps) == (reached, 4, (44,))
    key = lane_key(7, "evaluation", 4)
    alone = returns(policy, [lane_generator(key, n) for n in range(5)])
    assert alone.mean() == pytest.approx(reached, rel=1e-5)  # weights are float32
    assert [w.shape for w, _ in policy.layers] == [w.shape for w, _ in expert.policy.layers]
    for one, two in zip(policy.layers[:-1], expert.policy.layers[:-1], strict=True):
        assert all(map(torch.equal, one, two))


def test_components_are_uncorrelated_and_of_unit_variance() -> None:
    search = made()
    seen: list[np.ndarray] = []

    def act(frames: np.ndarray) -> np.ndarray:
        upright = ~search._evaluated.terminated
        z = (search._shown(frames) - search._centre) @ search._basis
        seen.append(z[upright])
        return toy_expert().act(frames)

    search._episodes(act, search._evaluated, "components", 0)
    z = np.concatenate(seen)
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.cov(z.T), np.eye(3), atol=1e-6)


def test_an_iteration_by_plain_code() -> None:
    search = made()
    search._theta = 0.1 * np.random.default_rng(1).normal(size=search._theta.shape)
    before = search._theta.copy()
    delta = lane_generator(lane_key(7, "directions"), 3).standard_normal((4, *before.shape))
    found = np.zeros((4, 2))
    for n in range(4):
        for side, sign in enumerate((1.0, -1.0)):
            # both episodes of a pair begin alike
            start = lane_generator(lane_key(7, "search", 3), n)
            theta = before + sign * TINY.perturbation * delta[n]
            rewards = episode_rewards(
                lambda frames, theta=theta: search._act(frames, theta),
                ToyRobot(1),
                [start],
                HORIZON,
            )
            found[n, side] = rewards.sum()
    metrics = search.update(3)
    assert float(metrics["search/return"]) == pytest.approx(found.mean())
    step = np.zeros_like(before)
    for n in range(4):
        step += (found[n, 0] - found[n, 1]) * delta[n]
    expected = before + TINY.step_size / (4 * found.std()) * step
    np.testing.assert_allclose(search._theta, expected, rtol=1e-9)
    assert np.abs(search._theta - before).max() > 1e-3


def refined(work: Path) -> Any:
    work.mkdir(parents=True, exist_ok=True)
    return refine(
        TINY, 7, "toy", toy_expert().policy, ToyRobot, horizon=HORIZON, work=work, save_every=0.0
    )


def test_a_killed_search_goes_on_to_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = refined(tmp_path / "whole")
    again = killed_at([0, 3, 5], OutputSearch, refined, tmp_path / "killed", monkeypatch)
    assert whole[1:3] == again[1:3]
    for one, two in zip(whole[0].layers, again[0].layers, strict=True):
        assert all(map(torch.equal, one, two))
    assert whole[3].of_lane(0) == again[3].of_lane(0)
    steps, reached = whole[3].of_lane(0)["evaluation/return"]
    assert steps == [2, 4, 6]
    assert whole[1] == max(reached)
    assert whole[2] == steps[int(np.argmax(reached))]


def test_it_finds_an_expert_that_falls_less(tmp_path: Path) -> None:
    config = RefinementConfig(iterations=40, components=3, step_size=0.2, perturbation=0.1)
    expert = toy_expert(2.0).policy
    refined, _, _, _ = refine(config, 3, "toy", expert, ToyRobot, horizon=40, work=tmp_path)
    earned = []
    for policy in (expert, refined):
        starts = [np.random.default_rng(n) for n in range(50)]
        act = partial(act_in_double, policy)
        earned.append(episode_rewards(act, ToyRobot(50), starts, 40).sum(axis=1).mean())
    assert earned[1] > earned[0] + 20.0  # measured 40.5 and then 95.4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"iterations": -1}, "iterations must not be negative"),
        ({"directions": 0}, "directions, components, evaluate_every, episodes at least 1"),
        ({"evaluate_every": 7}, "evaluate_every=7 is more than iterations=6"),
        ({"step_size": 0.0}, "perturbation and step_size must be positive"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TINY, **changes)


def test_there_is_no_search_unless_asked_for() -> None:
    assert RefinementConfig().iterations == 0
