"""Cloning the operator of the small machine."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from components.models import supervised
from components.models.behaviour_policy import BehaviourPolicyConfig, fit_behaviour_policies
from components.models.supervised import StackedFit
from tests.components.interruption import killed_at, lanes, save_always
from tests.components.synthetic import CPU, controller, keys, make_log

SMALL = BehaviourPolicyConfig(hidden=(8,), epochs=3, batch=16, learning_rate=1e-3)


def test_a_deterministic_operator_is_cloned() -> None:
    log = make_log(episodes=20, steps=60, explore=0.1)
    clean = make_log(seed=1, episodes=4, steps=60, explore=0.0)
    config = BehaviourPolicyConfig(epochs=60, batch=64, learning_rate=5e-3)
    [policy], [metrics], curves = fit_behaviour_policies([log], config, keys("clone"), CPU)
    starts = clean.frame_rows()[clean.frame_rows() - clean.first_rows() >= 2]
    histories = torch.from_numpy(np.stack([clean.frames[starts - lag] for lag in range(3)], axis=1))
    actions = policy.act(histories[None])[0].numpy()
    truth = controller(clean.frames[starts, 1:4].astype(np.float64))
    error = float(np.square(actions - truth).mean())
    spread = float(truth.var(axis=0).mean())
    # measured 0.0014 against 0.050, which a clone that always takes the mean action would reach
    assert error < 0.1 * spread
    # A tenth of the steps explores, which costs a perfect clone 1/3 + mean a^2 there, about 0.04
    # in all; measured 0.059 on two held-out trajectories.
    assert metrics["validation_mse"] < 0.08
    steps, values = curves.of_lane(0)["model/validation_loss"]
    assert len(steps) == 60
    assert metrics["validation_mse"] == pytest.approx(min(values), rel=1e-6)


def test_held_out_trajectories_are_never_trained_on() -> None:
    log = make_log(episodes=5, steps=40)
    changed = make_log(episodes=5, steps=40)
    changed.actions[4 * 40 :] *= -1.0  # holdout 0.1 of five trajectories: the last one
    changed.frames[4 * 41 :] += 7.0  # frames are scaled by those that are trained on
    config = BehaviourPolicyConfig(hidden=(8,), epochs=1, batch=16)
    results = [fit_behaviour_policies([d], config, keys(0), CPU) for d in (log, changed)]
    for (ours, _), (theirs, _) in zip(*(r[0][0].layers for r in results), strict=True):
        assert torch.equal(ours, theirs)
    scaling = [policy.frames for [policy], _, _ in results]
    assert torch.equal(scaling[0].mean, scaling[1].mean)
    assert torch.equal(scaling[0].scale, scaling[1].scale)
    np.testing.assert_allclose(scaling[0].mean[0], log.frames[: 4 * 41].mean(axis=0), rtol=1e-5)
    assert results[0][1] != results[1][1]


def test_held_out_loss_by_hand() -> None:
    log = make_log(episodes=5, steps=40)
    [policy], [metrics], _ = fit_behaviour_policies(
        [log], BehaviourPolicyConfig(hidden=(8,), epochs=1, batch=16), keys(0), CPU
    )
    rows, first = log.frame_rows()[160:], log.first_rows()[160:]
    histories = np.stack([log.frames[np.maximum(rows - lag, first)] for lag in range(3)], axis=1)
    actions = policy.act(torch.from_numpy(histories)[None])[0].numpy()
    by_hand = float(np.square(actions - log.actions[160:]).mean())
    assert metrics["validation_mse"] == pytest.approx(by_hand, rel=1e-4)  # float32 sums


def test_lanes_learn_as_alone() -> None:
    logs = [make_log("one", seed=1), make_log("two", seed=2, explore=0.1)]
    both, losses, _ = fit_behaviour_policies(logs, SMALL, keys("a", "b"), CPU)
    for log, name, policy, loss in zip(logs, "ab", both, losses, strict=True):
        [alone], [expected], _ = fit_behaviour_policies([log], SMALL, keys(name), CPU)
        assert alone.card == policy.card
        for (ours, _), (theirs, _) in zip(policy.layers, alone.layers, strict=True):
            # forty Adam updates in float32; stacking may change the order of sums
            torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)
        assert loss["validation_mse"] == pytest.approx(expected["validation_mse"], rel=1e-4)


def test_schedule_and_weight_decay_reach_the_optimiser() -> None:
    """Their defaults change nothing, a falling rate and a pull do."""
    log = make_log(episodes=5, steps=40)

    def size(config: BehaviourPolicyConfig) -> float:
        [policy], _, _ = fit_behaviour_policies([log], config, keys(0), CPU)
        return float(sum(weight.square().sum() for weight, _ in policy.layers))

    plain = size(SMALL)
    assert size(dataclasses.replace(SMALL, schedule="constant", weight_decay=0.0)) == plain
    assert size(dataclasses.replace(SMALL, schedule="cosine")) != plain
    assert size(dataclasses.replace(SMALL, weight_decay=1.0)) < 0.99 * plain


@pytest.mark.parametrize("deaths", [[0], [11], [10, 25], [35]])
def test_interrupted_equals_uninterrupted(
    deaths: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_always(monkeypatch, supervised)
    logs = [make_log("one", seed=1), make_log("two", seed=2)]

    def fit(checkpoint: Path | None) -> tuple:
        return fit_behaviour_policies(logs, SMALL, keys("a", "b"), CPU, checkpoint)

    expected = fit(None)
    found = killed_at(deaths, StackedFit, fit, tmp_path / "c", monkeypatch)
    for ours, theirs in zip(found[0], expected[0], strict=True):
        for (w, b), (v, c) in zip(ours.layers, theirs.layers, strict=True):
            assert torch.equal(w, v)
            assert torch.equal(b, c)
    assert found[1] == expected[1]
    assert lanes(found[2], 2) == lanes(expected[2], 2)


def test_what_was_best_survives_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At so high a rate the best state lies before the last checkpoint, the one after update 40."""
    save_always(monkeypatch, supervised)
    config = BehaviourPolicyConfig(hidden=(8,), epochs=8, batch=32, learning_rate=0.05)
    logs = [make_log("one", seed=1), make_log("two", seed=2)]

    def fit(checkpoint: Path | None) -> tuple:
        return fit_behaviour_policies(logs, config, keys("a", "b"), CPU, checkpoint)

    expected = fit(None)
    for lane in (0, 1):
        _, losses = expected[2].of_lane(lane)["model/validation_loss"]
        assert min(losses[:6]) < min(losses[6:]), "epochs of six updates"
    found = killed_at([45], StackedFit, fit, tmp_path / "c", monkeypatch)
    for ours, theirs in zip(found[0], expected[0], strict=True):
        for (w, _), (v, _) in zip(ours.layers, theirs.layers, strict=True):
            assert torch.equal(w, v)
    assert found[1] == expected[1]
