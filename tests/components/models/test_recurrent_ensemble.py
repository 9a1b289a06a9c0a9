"""The recurrent ensemble: closed loop, learning, early stopping, storage, resumption."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.core.tensors import save_tensors
from components.data.dynamics import DynamicsSpecification
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.models.recurrent_ensemble import fit as recurrent_fit
from components.models.recurrent_ensemble.ensemble import (
    RecurrentEnsemble,
    RecurrentEnsembleConfig,
    predict_windows,
)
from components.models.recurrent_ensemble.fit import fit_recurrent_ensemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.recurrent_ensemble.windows import TrainingWindows
from components.models.supervised import Fit
from components.models.transition.model_environment import ModelEnvironment
from tests.components.interruption import killed_at, save_always
from tests.components.synthetic import CPU, FATIGUE_ALONE, SCALE, make_log, random_ensemble

TINY = RecurrentEnsembleConfig(
    members=2, hidden=6, warm_up=5, horizon=8, batch=16, updates=40, validate_every=7, holdout=0.2
)
LOG = make_log()

NAMES = ["fatigue0", "fatigue1", "consumption0", "consumption1"]


def predict(ensemble: RecurrentEnsemble, windows: Tensor) -> Tensor:
    """Of an ensemble, with the warm-up of the small settings."""
    return predict_windows(
        ensemble.weight, ensemble.readout, windows, TINY.warm_up, ensemble.feedback
    )


def by_loop(weight: Tensor, readout: Tensor, windows: Tensor, warm_up: int) -> Tensor:
    """Own predictions fed back by hand, from the second predicted step on."""
    width = weight.shape[1]
    hidden = windows.new_zeros(weight.shape[0], width, windows.shape[-1])
    predictions: list[Tensor] = []
    for t, x in enumerate(windows):
        own = x[:, 4:].clone()
        if t > warm_up:  # the first half, the fatigue networks, feed themselves
            own[: len(own) // 2] = predictions[-1][: len(own) // 2, None]
        ones = torch.ones_like(own)
        hidden = torch.tanh(weight @ torch.cat([hidden, x[:, :4], own, ones], dim=1))
        predictions.append((readout @ torch.cat([hidden, ones], dim=1)).squeeze(1))
    return torch.stack(predictions[warm_up:])


def test_closed_loop_equals_feeding_predictions_back() -> None:
    g = torch.Generator().manual_seed(0)
    made = [
        (0.6 * torch.randn(shape, generator=g, dtype=torch.float64)).requires_grad_()
        for shape in ((4, 6, 12), (4, 1, 7))
    ]
    windows = torch.randn(13, 4, 5, 9, generator=g, dtype=torch.float64)
    windows[:, 2:, 4] = 0.0  # consumption networks have no own value
    ours = predict_windows(*made, windows, TINY.warm_up, FATIGUE_ALONE)
    theirs = by_loop(*made, windows, TINY.warm_up)
    assert ours.shape == (8, 4, 9)
    torch.testing.assert_close(ours, theirs)
    gradients = [torch.autograd.grad(p.square().sum(), made) for p in (ours, theirs)]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def test_recorded_values_are_read_up_to_the_first_predicted_step() -> None:
    ensemble = random_ensemble(LOG, 0, members=2, hidden=6)
    windows = torch.randn(13, 4, 5, 9, generator=torch.Generator().manual_seed(0))
    before = predict(ensemble, windows)
    for row, matters in ((TINY.warm_up, True), (TINY.warm_up + 1, False)):
        changed = windows.clone()
        changed[row, :2, 4] += 1.0
        after = predict(ensemble, changed)
        assert torch.equal(before, after) != matters


def test_windows_pair_the_steerings_after_the_action_with_the_value_before() -> None:
    windows = TrainingWindows(LOG, TINY, CPU)
    start = torch.tensor([[0], [1], [44], [20]])  # one frame row per network
    inputs, targets = windows.gather(start + TINY.warm_up * torch.tensor([[1], [1], [2], [1]]))
    assert inputs.shape == (13, 4, 5, 1)
    scaling = windows.normaliser
    scaled = (torch.from_numpy(LOG.frames) - scaling.mean) / scaling.scale
    for network, row in enumerate(start.flatten().tolist()):
        for t in range(13):
            torch.testing.assert_close(inputs[t, network, :4, 0], scaled[row + t + 1, :4])
            own = float(scaled[row + t, 4]) if network < 2 else 0.0
            assert float(inputs[t, network, 4, 0]) == own
        feature = 4 if network < 2 else 5
        expected = scaled[row + 6 : row + 14, feature]
        torch.testing.assert_close(targets[:, network, 0], expected)


def test_windows_stay_inside_their_trajectory_and_their_split() -> None:
    windows = TrainingWindows(LOG, TINY, CPU)  # 6 trajectories, 2 of them held out
    # Five repeated frames before the 41 of a trajectory: only windows of training may begin there.
    starts = [46 * e + np.arange(5 + 40 - 13 + 1) for e in range(6)]
    assert windows.train.tolist() == np.concatenate(starts[:4]).tolist()
    assert windows.held_out.tolist() == np.concatenate([s[5:] for s in starts[4:]]).tolist()
    seen = LOG.frames[: 4 * 41]
    np.testing.assert_allclose(windows.normaliser.mean, seen.mean(axis=0), rtol=1e-5)
    scaled = windows.normaliser.apply(torch.from_numpy(seen))[:, 4:]
    assert torch.equal(windows.low, scaled.amin(dim=0))
    assert torch.equal(windows.high, scaled.amax(dim=0))


def test_windows_may_begin_in_the_repeated_first_frame() -> None:
    """As the histories of the first states do, from which virtual trajectories start."""
    windows = TrainingWindows(LOG, TINY, CPU)
    inputs, targets = windows.gather(torch.full((4, 1), 46 + 2))  # of the second trajectory
    scaled = windows.normaliser.apply(torch.from_numpy(LOG.frames))
    rows = 41 + np.maximum(np.arange(-3, 11), 0)
    for t in range(13):
        torch.testing.assert_close(inputs[t, 0, :4, 0], scaled[rows[t + 1], :4])
        assert float(inputs[t, 0, 4, 0]) == float(scaled[rows[t], 4])
    torch.testing.assert_close(targets[:, 0, 0], scaled[rows[6:14], 4])


def test_where_an_observation_is_one_frame_nothing_is_repeated() -> None:
    windows = TrainingWindows(make_log(history=1), TINY, CPU)
    starts = [41 * e + np.arange(40 - 13 + 1) for e in range(4)]
    assert windows.train.tolist() == np.concatenate(starts).tolist()


@pytest.mark.slow(2)
def test_learns_the_small_machine() -> None:
    log = make_log(episodes=20, steps=60)
    config = RecurrentEnsembleConfig(
        members=2, hidden=12, warm_up=5, horizon=10, batch=64, updates=400, validate_every=50,
        learning_rate=1e-2,
    )  # fmt: skip
    fit = fit_recurrent_ensemble(log, config, lane_key("fit"), CPU)
    for name in NAMES:
        _, values = fit.curves[f"model/train_mse/{name}"]
        # mean over the first 50 updates against the last; measured factors of 160 and more
        assert values[-1] < values[0] / 20
    # predicting the mean gives about 1; measured 0.001 and 0.0005
    assert fit.metrics["validation_mse/fatigue"] < 0.02
    assert fit.metrics["validation_mse/consumption"] < 0.02
    assert fit.model.members == 2


def test_consumption_networks_read_no_own_value() -> None:
    """Training must not move the column, which roll-outs feed with zero: they would disagree."""
    ensemble = fit_recurrent_ensemble(LOG, TINY, lane_key("column"), CPU).model
    assert ensemble.weight[:2, :, 6 + 4].all()
    assert not ensemble.weight[2:, :, 6 + 4].any()


def test_training_and_roll_outs_predict_the_same() -> None:
    """The loss's closed loop and the model environment's are one and the same."""
    ensemble = fit_recurrent_ensemble(LOG, TINY, lane_key("same"), CPU).model
    alone = RecurrentEnsemble(
        ensemble.weight[::2],  # a machine of one pair has no choice to make
        ensemble.readout[::2],
        ensemble.frames,
        ensemble.low - 99.0,
        ensemble.high + 99.0,
        ensemble.feedback,
        ensemble.warm_up,
    )
    windows = TrainingWindows(LOG, TINY, CPU)
    start = windows.held_out[:7]
    inputs, _ = windows.gather(start.expand(4, -1))
    expected = predict(alone, inputs[:, ::2])
    start = start - TINY.warm_up * (1 + start // 46)  # frame rows
    rows = start[:, None] + TINY.warm_up - torch.arange(TINY.warm_up + 1)
    history = torch.from_numpy(LOG.frames)[rows][None]
    actions = [LOG.frames[start + TINY.warm_up + t + 1, 1:4] for t in range(TINY.horizon)]
    plain = Normaliser(torch.zeros(1, 6), torch.ones(1, 6))
    virtual = ModelEnvironment(
        RecurrentTransition([alone], CPU), DynamicsSpecification.of_card(LOG.card), plain, CPU
    )
    seen: list[Tensor] = []

    def act(observation: Tensor) -> Tensor:
        seen.append(observation[0, :, :6])
        moved = torch.from_numpy(actions[len(seen) - 1]) - observation[0, :, 1:4]
        return (moved / torch.tensor(SCALE).float())[None]

    assert len(list(virtual.unroll(history.flatten(2), history, act, TINY.horizon))) == TINY.horizon
    for t, frame in enumerate(seen[1:]):
        scaled = ensemble.frames.apply(frame)[:, 4:]
        # eight recurrent steps in float32, scaled and unscaled
        torch.testing.assert_close(scaled, expected[t].T, rtol=1e-3, atol=1e-3)


def test_reported_loss_belongs_to_the_best_state() -> None:
    fit = fit_recurrent_ensemble(LOG, TINY, lane_key("best"), CPU)
    ensemble, metrics = fit.model, fit.metrics
    windows = TrainingWindows(LOG, TINY, CPU)
    inputs, targets = windows.gather(windows.held_out.expand(4, -1))
    predicted = by_loop(ensemble.weight, ensemble.readout, inputs, TINY.warm_up)
    losses = (predicted - targets).square().mean(dim=(0, 2)).tolist()
    for name, loss in zip(NAMES, losses, strict=True):
        assert metrics[f"validation_mse/{name}"] == pytest.approx(loss, rel=1e-4)  # float32
    mean = (metrics["validation_mse/fatigue0"] + metrics["validation_mse/fatigue1"]) / 2
    assert metrics["validation_mse/fatigue"] == pytest.approx(mean)
    assert fit.validation_loss == pytest.approx(sum(losses) / 4, rel=1e-4)
    steps, _ = fit.curves["model/validation_mse/fatigue0"]
    assert steps == [7, 14, 21, 28, 35, 40]


def test_stops_when_no_network_improves() -> None:
    # With a rate this large the networks only get worse after a while.
    config = dataclasses.replace(
        TINY, updates=5000, learning_rate=3.0, validate_every=2, patience=3
    )
    curves = fit_recurrent_ensemble(LOG, config, lane_key("stop"), CPU).curves
    steps, _ = curves["model/validation_mse/fatigue0"]
    assert steps[-1] < 5000
    values = np.array([curves[f"model/validation_mse/{name}"][1] for name in NAMES])
    best = values.argmin(axis=1)
    assert best.max() == len(steps) - 1 - config.patience


def test_members_differ_and_do_not_feel_each_other() -> None:
    four = fit_recurrent_ensemble(LOG, TINY, lane_key("k"), CPU).model
    more = dataclasses.replace(TINY, members=3)
    six = fit_recurrent_ensemble(LOG, more, lane_key("k"), CPU).model
    assert not torch.equal(four.weight[0], four.weight[1])
    for network, same in ((0, 0), (1, 1), (2, 3), (3, 4)):
        # forty updates in float32; stacking may change the order of sums
        torch.testing.assert_close(four.weight[network], six.weight[same], rtol=1e-3, atol=1e-5)


def test_storage(tmp_path: Path) -> None:
    ensemble = random_ensemble(LOG, 0)
    ensemble.save(tmp_path)
    loaded = RecurrentEnsemble.load(tmp_path)
    for name in ("weight", "readout", "low", "high"):
        assert torch.equal(getattr(loaded, name), getattr(ensemble, name))
    assert torch.equal(loaded.frames.scale, ensemble.frames.scale)
    save_tensors(tmp_path / "ensemble.safetensors", {"x": torch.zeros(1)}, {"format": "policy/1"})
    with pytest.raises(ValueError, match=r"ensemble\.safetensors holds 'policy/1', expected"):
        RecurrentEnsemble.load(tmp_path)


def test_logs_that_do_not_fit_are_refused() -> None:
    long = dataclasses.replace(TINY, warm_up=40)
    with pytest.raises(ValueError, match=r"Trajectory 0 of toy is shorter than .* = 48 steps"):
        fit_recurrent_ensemble(LOG, long, 0, CPU)
    features = ("position", *LOG.card.frame_features[1:])
    other = dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, frame_features=features))
    with pytest.raises(ValueError, match=r"needs frames of .* but toy logs .*'position'"):
        fit_recurrent_ensemble(other, TINY, 0, CPU)


@pytest.mark.parametrize("deaths", [[3], [10], [25, 39], [21, 22]])
def test_interrupted_equals_uninterrupted(
    deaths: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_always(monkeypatch, recurrent_fit)

    def fit(checkpoint: Path | None) -> Fit:
        return fit_recurrent_ensemble(LOG, TINY, lane_key("resume"), CPU, checkpoint)

    expected = fit(None)
    found = killed_at(deaths, recurrent_fit._EnsembleLearner, fit, tmp_path / "c", monkeypatch)
    assert torch.equal(found.model.weight, expected.model.weight)
    assert torch.equal(found.model.readout, expected.model.readout)
    assert found.metrics == expected.metrics
    assert found.curves == expected.curves


def test_what_was_best_survives_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a rate that only does harm, the best state lies long before the kill."""
    config = dataclasses.replace(
        TINY, updates=5000, learning_rate=3.0, validate_every=4, patience=8
    )
    save_always(monkeypatch, recurrent_fit)

    def fit(checkpoint: Path | None) -> Fit:
        return fit_recurrent_ensemble(LOG, config, lane_key("stop"), CPU, checkpoint)

    expected = fit(None)
    steps, _ = expected.curves["model/validation_mse/fatigue0"]
    learner = recurrent_fit._EnsembleLearner
    found = killed_at([steps[-1] - 1], learner, fit, tmp_path / "c", monkeypatch)
    assert torch.equal(found.model.weight, expected.model.weight)
    assert found.metrics == expected.metrics
    assert found.curves == expected.curves


@pytest.mark.slow(135)
def test_default_settings_reach_the_required_accuracy() -> None:
    """The whole default budget on the real mediocre-1.0, 163 s on one core.

    Measured 0.028 (fatigue) and 0.0022 (consumption).
    """
    log = generate(IndustrialSpec("mediocre-1.0", "mediocre", 1.0), seed=0)
    key = lane_key("mediocre-1.0", "recurrent_ensemble", 0)
    metrics = fit_recurrent_ensemble(log, RecurrentEnsembleConfig(), key, CPU).metrics
    assert metrics["validation_mse/fatigue"] <= 0.05
    assert metrics["validation_mse/consumption"] <= 0.008
