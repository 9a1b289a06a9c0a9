"""MOPO's penalty and virtual trajectories, against plain loops."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms import mopo
from components.algorithms.mopo import percentile, uncertainty
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from components.models.transition.interface import Prediction
from tests.components.algorithms.mopo_worlds import (
    COUNT,
    LENGTH,
    LOG,
    OTHER,
    STEPS,
    constant,
    made_of,
    raw_targets,
    true_ensemble,
)
from tests.components.algorithms.parts.test_model_buffer import frames_before, seen
from tests.components.algorithms.plain import floats, gaussian_parameters
from tests.components.algorithms.stacks import learner
from tests.components.synthetic import (
    SCALE,
    next_outputs,
    random_model,
)

# -- the penalty ------------------------------------------------------------------------------


def test_uncertainty_is_the_largest_norm_of_all_members() -> None:
    # [L, D, K, B]: one lane, two targets, three members, two trajectories
    spread = torch.tensor(
        [[[[3.0, 0.0], [1.0, 1.0], [0.0, 0.5]], [[4.0, 2.0], [1.0, 1.0], [5.5, 0.0]]]]
    )
    found = uncertainty(Prediction(torch.zeros_like(spread), spread))
    # norms 5, sqrt 2, 5.5 of the first trajectory; 2, sqrt 2, 0.5 of the second
    assert found.tolist() == [[5.5, 2.0]]


def test_deterministic_members_are_no_basis_for_a_penalty() -> None:
    with pytest.raises(ValueError, match="needs Gaussian members"):
        uncertainty(Prediction(torch.zeros(1, 2, 3, 4)))
    deterministic = random_model("deterministic_ensemble", LOG)
    with pytest.raises(ValueError, match="needs Gaussian members"):
        made_of([deterministic]).update(0)


def test_percentiles_by_hand() -> None:
    values = torch.tensor([[4.0, 1.0, 10.0, 7.0, 2.0, 9.0, 3.0, 8.0, 6.0, 5.0]])
    found = [percentile(values, p).tolist() for p in (50, 90, 91, 99)]
    assert found == [[5.0], [9.0], [10.0], [10.0]]
    assert percentile(torch.tensor([[3.0], [4.0]]), 50).tolist() == [3.0, 4.0]


def test_members_outside_the_elites_raise_the_penalty_too() -> None:
    deviations = [[0.1, 0.2], [0.3, 0.4], [1.2, 0.5]]  # the last is no elite; norm 1.3
    made = made_of([constant([[0.0, 0.0]] * 3, deviations, [0, 1])], penalty=2.0)
    metrics = made.update(0)
    for name in ("model/penalty", "model/penalty_50", "model/penalty_99"):
        assert metrics[name].item() == pytest.approx(1.3, rel=1e-5)  # float32
    frames = made._buffer.frames[:, :COUNT].flip(2)  # oldest first
    rewards = raw_targets(made, frames) @ [-0.03, -0.01]
    # float32 rewards of some units
    np.testing.assert_allclose(made._buffer.rewards[:, :COUNT], rewards - 2.0 * 1.3, atol=1e-5)
    assert metrics["model/virtual_reward"].item() == pytest.approx(rewards.mean(), rel=1e-5)


def test_stored_rewards_fall_by_lambda_times_the_uncertainty() -> None:
    """Whatever the penalty, the first trajectories are the same."""
    free, *priced = [learner("mopo", [LOG, OTHER], [0, 1], penalty=p) for p in (0.0, 0.5, 2.5)]
    doubts = []
    for made, price in zip(priced, (0.5, 2.5), strict=True):
        free._roll_out(0), made._roll_out(0)
        assert torch.equal(made._buffer.frames, free._buffer.frames)
        doubts.append((free._buffer.rewards - made._buffer.rewards)[:, :COUNT] / price)
    assert doubts[0].min() > 0.1  # and not the same everywhere
    assert doubts[0].std() > 0.01
    # float32 differences of rewards of some units
    torch.testing.assert_close(doubts[0], doubts[1], rtol=0, atol=1e-5)


# -- virtual trajectories ---------------------------------------------------------------------


def plain_member(model: MLPEnsemble, member: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standardised change and deviation that a member predicts from its normalised inputs."""
    layers = [(floats(w)[member], floats(b)[member, 0]) for w, b in model.layers]
    for weight, bias in layers[:-1]:
        x = x @ weight + bias
        x = x / (1.0 + np.exp(-x))
    out = x @ layers[-1][0] + layers[-1][1]
    low, high = floats(model.log_variance)[member]
    below = high - np.log1p(np.exp(high - out[2:]))
    return out[:2], np.exp(0.5 * (low + np.log1p(np.exp(below - low))))


def plain_trajectory(
    made: mopo.Learner, model: MLPEnsemble, lane: int, drawn: dict[str, np.ndarray], clipped: bool
) -> dict[str, list]:
    """One trajectory, step by step in double precision."""
    log = made._data.datasets[lane]
    scaling = made._data.frame_scaling
    mean, scale = floats(scaling.mean)[lane], floats(scaling.scale)[lane]
    own_mean, own_scale = floats(model.frames.mean), floats(model.frames.scale)
    low, high = floats(model.low), floats(model.high)
    frames = [f * scale + mean for f in frames_before(log, int(drawn["start"]))]
    found: dict[str, list] = {name: [] for name in ("frame", "action", "reward", "outside")}
    for t in range(LENGTH):
        centre, log_std = gaussian_parameters(
            made._actor.stack, lane, seen([(f - mean) / scale for f in frames])
        )
        std = np.exp(np.clip(log_std, -20.0, 2.0))
        action = np.tanh(centre + std * drawn["action"][t])
        steering = np.clip(frames[-1][1:4] + SCALE * action, 0.0, 100.0)
        inputs = np.concatenate([frames[-1][:1], steering])
        own = [(f - own_mean) / own_scale for f in frames]
        x = np.concatenate([seen(own), (inputs - own_mean[:4]) / own_scale[:4]])
        said = [plain_member(model, k, x) for k in range(model.members)]
        elite = model.elites[int(drawn["elite"][t])]
        change = said[elite][0] + said[elite][1] * drawn["frame"][t]
        targets = own[-1][4:] + change * floats(model.target_scale) + floats(model.target_mean)
        found["outside"].append(bool(((targets < low) | (targets > high)).any()))
        if clipped:
            targets = np.clip(targets, low, high)
        raw = targets * own_scale[4:] + own_mean[4:]
        doubt = max(math.hypot(*deviation) for _, deviation in said)
        frames.append(np.concatenate([inputs, raw]))
        found["frame"].append((frames[-1] - mean) / scale)
        found["action"].append(action)
        found["reward"].append(-0.03 * raw[0] - 0.01 * raw[1] - made._config.penalty * doubt)
    return found


@pytest.mark.parametrize("limits", ["free", "data"])
def test_trajectories_by_plain_loops(limits: str) -> None:
    """Policy, random elites, samples, rewards and penalties of two lanes with their own data."""
    made = learner("mopo", [LOG, OTHER], [0, 1], penalty=0.7, prediction_range=limits)
    drawn = {name: floats(value) for name, value in made._rollout_streams.at(1).items()}
    metrics = made._roll_out(1)
    outside = []
    for lane, log in enumerate((LOG, OTHER)):
        model = random_model("gaussian_ensemble", log)
        for n in range(COUNT):
            one = {name: value[lane, n] for name, value in drawn.items()}
            found = plain_trajectory(made, model, lane, one, limits == "data")
            place = COUNT + n  # the second roll-out stands behind the first
            assert made._buffer.start[lane, place] == one["start"]
            for stored, expected in (
                (made._buffer.frames[lane, place].flip(0), found["frame"]),  # newest first
                (made._buffer.actions[lane, place], found["action"]),
                (made._buffer.rewards[lane, place], found["reward"]),
            ):
                # four steps in float32
                np.testing.assert_allclose(stored.detach().numpy(), expected, rtol=1e-4, atol=1e-4)
            outside.append(found["outside"])
    share = np.mean(np.reshape(outside, (2, -1)), axis=1)
    assert share.min() > 0.02, "the range must matter for this test to say something"
    assert metrics["model/outside_share"].tolist() == pytest.approx(share.tolist(), rel=1e-6)


def test_a_model_that_knows_the_machine_reproduces_its_return() -> None:
    """Zero spread and a fixed policy: the stored rewards are those of the machine itself."""
    steps, actions = 25, np.array([0.3, -0.5, 0.2])
    known = true_ensemble(LOG, [-50.0] * 2, [0.0] * 2, [0, 1])
    made = made_of([known], rollout_length=steps, penalty=1.0)
    with torch.no_grad():
        last = made._actor.stack.layers[-1]
        last.weight.zero_()
        # log deviations of -20: the noise cannot be seen
        last.bias[0, 0] = torch.tensor([*np.arctanh(actions), *[-20.0] * 3])
    made.update(0)
    discounts = 0.97 ** np.arange(steps)
    for n in range(COUNT):
        row = int(made._buffer.start[0, n])
        frame = LOG.frames[row + row // STEPS].astype(np.float64)
        steering, fatigue, expected = frame[1:4], frame[4], 0.0
        for t in range(steps):
            steering = np.clip(steering + SCALE * actions, 0.0, 100.0)
            fatigue, consumption = next_outputs(steering[None], np.array([fatigue]))[0]
            expected += discounts[t] * (-0.03 * fatigue - 0.01 * consumption)
        found = discounts @ floats(made._buffer.rewards)[0, n]
        assert found == pytest.approx(expected, rel=1e-4)  # 25 steps in float32


def test_elites_alone_are_followed_each_as_often() -> None:
    """Members give themselves away by the change they predict."""
    changes = [[0.1 * k, -0.1 * k] for k in range(5)]
    silent = [[1e-9, 1e-9]] * 5
    elites = [(0, 3, 4), (4, 1, 2)]
    count = 3000
    made = made_of([constant(changes, silent, e) for e in elites], rollouts=count)
    made.update(0)
    for lane, allowed in enumerate(elites):
        scaling = made._data.frame_scaling
        new = floats(made._buffer.frames[lane, :count]).transpose(1, 0, 2)[::-1]  # [T, N, F]
        raw = new * floats(scaling.scale)[lane] + floats(scaling.mean)[lane]
        first = made._buffer.start[lane, :count].numpy()
        before = LOG.frames[first + first // STEPS].astype(np.float64)
        own = floats(constant(changes, silent, elites[0]).frames.scale)
        chosen = np.diff(np.stack([before, *raw])[..., 4] / own[4], axis=0) / 0.1
        assert np.abs(chosen - chosen.round()).max() < 0.01  # float32 changes of 0.1
        numbers = chosen.round().astype(int)
        assert set(np.unique(numbers)) == set(allowed)
        for member in allowed:
            drawn = numbers == member
            # five standard errors of 3,000 draws with chance 1/3, at every step
            np.testing.assert_allclose(drawn.mean(axis=1), 1 / 3, atol=5 * 0.0086)
            # and of pairs with chance 1/9: every step draws anew
            pairs = (drawn[1:] & drawn[:-1]).mean(axis=1)
            np.testing.assert_allclose(pairs, 1 / 9, atol=5 * 0.0057)


def test_sampled_frames_have_the_predicted_moments() -> None:
    change, deviation, count = np.array([0.2, -0.1]), np.array([0.5, 0.25]), 4000
    model = constant([change] * 2, [deviation] * 2, [0, 1])
    model = dataclasses.replace(model, target_scale=torch.tensor([0.4, 0.8]))
    made = made_of([model], rollouts=count, rollout_length=2)
    made.update(0)
    own = floats(model.frames.scale)[4:]
    raw = raw_targets(made, made._buffer.frames[:, :count])[0] / own  # [N, T, D], newest first
    drawn = raw[:, 0] - raw[:, 1]  # the second step's changes
    mean, spread = change * [0.4, 0.8], deviation * [0.4, 0.8]
    # five standard errors of a mean, a deviation and a correlation of 4,000 draws
    error = 5.0 / math.sqrt(count)
    assert (np.abs(drawn.mean(axis=0) - mean) < error * spread).all()
    assert (np.abs(drawn.std(axis=0) - spread) < error * spread / math.sqrt(2.0)).all()
    assert abs(np.corrcoef(drawn.T)[0, 1]) < error
    first = made._buffer.start[0, :count].numpy()
    before = LOG.frames[first + first // STEPS, 4:].astype(np.float64) / own
    earlier = raw[:, 1] - before
    assert (np.abs(earlier.mean(axis=0) - mean) < error * spread).all()
    assert abs(np.corrcoef(drawn[:, 0], earlier[:, 0])[0, 1]) < error


def test_trajectories_begin_anywhere_in_the_log_and_come_in_bounded_chunks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mopo, "CHUNK", 150)
    made = learner("mopo", [LOG, OTHER], [0, 1], rollouts=1000)
    assert made._chunks == 7
    widths, unroll = [], made._environment.unroll

    def watched(history: Tensor, *arguments: Any, **options: Any) -> Any:
        widths.append(history.shape[1])
        return unroll(history, *arguments, **options)

    made._environment.unroll = watched
    made._roll_out(0)
    assert widths == [150] * 6 + [100]
    drawn = torch.cat([made._rollout_streams.at(n)["start"] for n in range(7)], dim=1)
    assert torch.equal(made._buffer.start[:, :1000], drawn[:, :1000])
    assert (made._buffer.rewards[:, :1000] != 0.0).all()
    assert (made._buffer.rewards[:, 1000:] == 0.0).all()
    # 1,000 draws of 240 rows: about 4.2 each; a first row of an episode and a last one among them
    counts = np.bincount(made._buffer.start[0, :1000].numpy(), minlength=240)
    assert len(counts) == 240
    assert counts.max() < 18  # Poisson(4.2) beyond 17: 1e-6 for each of 240
