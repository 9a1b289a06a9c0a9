"""Training of experts: resumed as uninterrupted, the best policy by whole episodes."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.core.random_streams import lane_generator, lane_key
from components.experts.episodes import episode_rewards, evaluate_episodes
from components.experts.online import OnlineLearner
from components.experts.training import train_experts, without_denormals
from components.training.divergence import DivergedError
from tests.components.data.sources.toy_robot import LIMIT, ToyRobot
from tests.components.experts.test_online import TINY, keys
from tests.components.interruption import KilledError, dying, killed_at, lanes

CPU = torch.device("cpu")
LASTING = dataclasses.replace(TINY, steps=100, evaluate_every=25)


def trained(work: Path, *seeds: int) -> Any:
    work.mkdir(parents=True, exist_ok=True)
    return train_experts(
        "toy",
        LASTING,
        keys(*seeds),
        [f"seed{seed}" for seed in seeds],
        lambda copies: ToyRobot(copies, 0.3),
        work=work,
        device=CPU,
        save_every=0.0,
    )


def weights(policy: Any) -> list[torch.Tensor]:
    return [tensor for layer in policy.layers for tensor in layer]


@pytest.mark.slow(2)
def test_a_killed_training_goes_on_to_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(tmp_path / "whole", 0, 1)
    # before any checkpoint, among the random steps, in the middle of episodes, at the end
    deaths = [0, 17, 44, 71, 99]
    folder = tmp_path / "killed"
    again = killed_at(deaths, OnlineLearner, lambda path: trained(path, 0, 1), folder, monkeypatch)
    assert whole[1] == again[1]
    for one, two in zip(whole[0], again[0], strict=True):
        assert one.card == two.card
        assert all(map(torch.equal, weights(one), weights(two)))
    assert lanes(whole[2], 2) == lanes(again[2], 2)
    for seed in (0, 1):
        stored = [tmp_path / w / f"seed{seed}.transitions" for w in ("whole", "killed")]
        assert stored[0].read_bytes() == stored[1].read_bytes()
        assert stored[0].stat().st_size == LASTING.steps * (3 + 2 + 1 + 1 + 3) * 4


@pytest.mark.slow(2)
def test_one_lane_of_a_checkpoint_can_be_finished_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(tmp_path / "whole", 0, 1)
    with monkeypatch.context() as patched:
        patched.setattr(OnlineLearner, "update", dying(OnlineLearner.update, 71))
        with pytest.raises(KilledError):
            trained(tmp_path / "part", 0, 1)
    [policy], [reached], _ = trained(tmp_path / "part", 1)
    # thirty updates alone instead of side by side
    assert reached == pytest.approx(whole[1][1], rel=1e-3)
    for one, two in zip(weights(policy), weights(whole[0][1]), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-2, atol=1e-3)


def test_the_best_evaluation_is_the_policys(tmp_path: Path) -> None:
    policies, reached, curves = trained(tmp_path, 0, 1)
    for lane, policy in enumerate(policies):
        steps, returns = curves.of_lane(lane)["evaluation/return"]
        assert steps == [25, 50, 75, 100]
        assert reached[lane] == max(returns)
        [step] = policy.card.steps
        assert step == steps[int(np.argmax(returns))]
        assert (policy.card.features, policy.card.history) == (("place", "speed", "tilt"), 1)
        # lived again, alone
        [key] = keys(lane)
        starts = [lane_generator(lane_key(key, "evaluation", step), n) for n in range(3)]

        def act(frames: np.ndarray, policy: Any = policy) -> np.ndarray:
            seen = torch.from_numpy(frames).float()[None, :, None]
            return policy.act(seen)[0].double().numpy()

        rewards = episode_rewards(act, ToyRobot(3, 0.3), starts, LASTING.horizon)
        assert rewards.sum(axis=1).mean() == pytest.approx(reached[lane], rel=1e-5)  # float32


class BreakingDDPG(OnlineLearner):
    """The second lane's policy is undefined from a step on."""

    at = 0

    def update(self, step: int) -> dict[str, torch.Tensor]:
        metrics = super().update(step)
        if step >= self.at:
            with torch.no_grad():
                for parameter in self.actor.parameters():
                    parameter[1] = torch.nan
        return metrics


@pytest.mark.parametrize(("at", "kept"), [(60, True), (40, False)])
def test_a_lane_that_diverges_keeps_its_best_finite_policy_or_has_none(
    at: int, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = trained(tmp_path / "whole", 0, 1)
    monkeypatch.setattr(BreakingDDPG, "at", at)
    monkeypatch.setattr("components.experts.training.OnlineLearner", BreakingDDPG)
    policies, _, curves = trained(tmp_path / "broken", 0, 1)
    assert all(map(torch.equal, weights(policies[0]), weights(expected[0][0])))
    assert policies[0].card.ended_at is None
    if kept:
        steps, returns = curves.of_lane(1)["evaluation/return"]
        assert steps == [25, 50]
        assert policies[1].card.steps == (steps[int(np.argmax(returns))],)
        assert policies[1].card.ended_at == curves.ended_at(1) > at
        assert policies[1].finite.all()
    else:
        assert isinstance(policies[1], DivergedError)
        assert "no longer finite at step 42, and no policy that had learned" in str(policies[1])


@pytest.mark.slow(4)
def test_it_learns_to_stand_and_to_run(tmp_path: Path) -> None:
    config = dataclasses.replace(
        TINY, steps=1400, random_steps=200, horizon=40, evaluate_every=100, hidden=(32, 32)
    )
    config = dataclasses.replace(config, batch=64, target_rate=0.02, learning_rate=1e-3)
    seeds = range(3)
    _, reached, curves = train_experts(
        "toy", config, keys(*seeds), [*map(str, seeds)], ToyRobot, work=tmp_path, device=CPU
    )
    # Untrained policies earn 16 to 39; standing still 40; running all the time 98. Six seeds
    # reached 95 to 98.
    assert max(curves.of_lane(lane)["evaluation/return"][1][0] for lane in seeds) < 60
    assert min(reached) > 80


def test_denormal_numbers_are_nothing_while_training_and_only_then() -> None:
    def tiny() -> float:
        return float(torch.tensor([1e-38]) * 1e-3)

    assert tiny() > 0.0
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor cannot round denormal numbers to 0")
    inside = []

    def dies() -> None:
        with without_denormals():
            inside.append(tiny())
            raise KilledError

    with pytest.raises(KilledError):
        dies()
    assert inside == [0.0]
    assert tiny() > 0.0


def test_rewards_after_a_fall_are_nothing_and_the_falls_own_one_counts() -> None:
    falls = [2, 5, 99]  # steps until |tilt| > LIMIT, from a start of 0, leaning by 1 / n

    def act(frames: np.ndarray) -> np.ndarray:
        lean = [1.01 * LIMIT / n for n in falls]
        return np.stack([np.zeros(3), lean], axis=1)

    class Upright(ToyRobot):
        def reset(self, rng: Any) -> np.ndarray:
            super().reset(rng)
            self._state[:] = 0.0
            return self._state.copy()

    generators = [np.random.default_rng(n) for n in range(3)]
    robots = Upright(3, unsteady=1.0)
    rewards = episode_rewards(act, robots, generators, 8)
    paid = [1.0 - 0.1 * (1.01 * LIMIT / n) ** 2 for n in falls]
    lived = [2, 5, 8]
    for n in range(3):
        np.testing.assert_allclose(rewards[n], [paid[n]] * lived[n] + [0.0] * (8 - lived[n]))
    achieved = evaluate_episodes(act, robots, generators, horizon=8, discount=0.5, return_steps=3)
    whole = [p * n for p, n in zip(paid, lived, strict=True)]
    assert achieved.return_mean == pytest.approx(np.mean(whole))
    assert achieved.return_std == pytest.approx(np.std(whole))
    first = [1.5 * paid[0], 1.75 * paid[1], 1.75 * paid[2]]
    assert achieved.discounted_return_mean == pytest.approx(np.mean(first))
