"""Models of a robot: nothing is known but the action, rewards are learned, falls are absorbing."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.models.recurrent_ensemble.ensemble import (
    Feedback,
    RecurrentEnsemble,
    RecurrentEnsembleConfig,
    predict_windows,
)
from components.models.recurrent_ensemble.fit import fit_recurrent_ensemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.recurrent_ensemble.windows import TrainingWindows
from components.models.transition.model_environment import (
    ModelEnvironment,
)
from tests.components.robot import make_robot_log
from tests.components.synthetic import CPU, make_log, random_ensemble

LOG = make_robot_log()
RULE = DynamicsSpecification.of_card(LOG.card)
JOINT = RecurrentEnsembleConfig(
    members=2, networks="joint", target="change", hidden=6, warm_up=3, horizon=8, batch=16,
    updates=40, validate_every=7, holdout=0.2,
)  # fmt: skip


def absorbed(log: OfflineDataset, episode: int, count: int) -> np.ndarray:
    """Machine frames of an episode and of what follows a fall: ``[<= T + 1 + count, 6]``."""
    start, end = log.episode_starts[episode : episode + 2]
    rows = list(model_frames(log, RULE)[start + episode : end + episode + 1])
    if log.terminated[end - 1]:
        back = itertools.cycle(log.actions[start:end][::-1])
        rows += [np.concatenate([next(back), rows[-1][2:5], [0.0]]) for _ in range(count)]
    return np.stack(rows)


def test_windows_with_absorption_by_hand() -> None:
    windows = TrainingWindows(LOG, JOINT, CPU)
    scaling = windows.normaliser
    split = 24 - 5  # of 24 episodes a fifth, rounded up, is held out
    expected = []
    for episode in range(split):
        frames = scaling.apply(torch.from_numpy(absorbed(LOG, episode, 7)).float())
        # A window is four recorded frames and eight predicted ones; the first is a logged one.
        expected += [frames[n : n + 12] for n in range(len(frames) - 11)]
    lengths = np.diff(LOG.episode_starts)[:split]
    falls = LOG.terminated[LOG.episode_starts[1 : split + 1] - 1]
    assert len(expected) == sum(
        max(0, length - 3 if falls else length - 10)
        for length, falls in zip(lengths, falls, strict=True)
    )
    assert len(windows.train) == len(expected)
    inputs, targets = windows.gather(windows.train.expand(2, -1))
    assert inputs.shape == (11, 2, 2 + 3, len(expected))
    assert targets.shape == (8, 2 * 4, len(expected))
    ended = 0
    for b, frames in enumerate(expected):
        for network in range(2):
            # scaled in another order of rows
            torch.testing.assert_close(inputs[:, network, :2, b], frames[1:, :2])
            torch.testing.assert_close(inputs[:, network, 2:, b], frames[:-1, 2:5])
            torch.testing.assert_close(targets[:, 4 * network : 4 * network + 4, b], frames[4:, 2:])
        ended += int((targets[1:, 3, b] == targets[-1, 3, b]).all())
    assert ended > 3, "some windows must be all but one step behind a fall"


def test_statistics_are_those_of_the_logged_training_frames() -> None:
    windows = TrainingWindows(LOG, JOINT, CPU)
    seen = model_frames(LOG, RULE)[: int(LOG.episode_starts[19]) + 19]
    np.testing.assert_allclose(windows.normaliser.mean, seen.mean(axis=0), atol=1e-6)
    scaled = windows.normaliser.apply(torch.from_numpy(seen))[:, 2:]
    assert torch.equal(windows.low, scaled.amin(dim=0))
    assert torch.equal(windows.high, scaled.amax(dim=0))


def test_episodes_too_short_for_a_window_are_left_out() -> None:
    config = dataclasses.replace(JOINT, warm_up=9, horizon=16)  # of 25 steps
    windows = TrainingWindows(LOG, config, CPU)
    lengths = np.diff(LOG.episode_starts)[:19]
    falls = LOG.terminated[LOG.episode_starts[1:20] - 1]
    assert lengths.min() < 10, "some episodes must be shorter than G + 1 steps"
    assert len(windows.train) == np.maximum(0, lengths[falls] - 9).sum() + (~falls).sum()
    with pytest.raises(ValueError, match="to be trained on; shorten these"):
        TrainingWindows(LOG, dataclasses.replace(JOINT, warm_up=40), CPU)


def changes_by_loop(ensemble: RecurrentEnsemble, windows: Tensor, warm_up: int) -> Tensor:
    """Predictions ``[F, M, 4, B]``; states are summed up by hand, the reward is what is read."""
    width = ensemble.weight.shape[1]
    hidden = windows.new_zeros(*ensemble.weight.shape[:2], windows.shape[-1])
    predictions: list[Tensor] = []
    for t, x in enumerate(windows):
        own = predictions[-1][:, :3] if t > warm_up else x[:, 2:]
        ones = torch.ones_like(x[:, :1])
        seen = torch.cat([hidden, x[:, :2], own, ones], dim=1)
        assert seen.shape[1] == ensemble.weight.shape[2] == width + 6
        hidden = torch.tanh(ensemble.weight @ seen)
        read = ensemble.readout @ torch.cat([hidden, ones], dim=1)
        predictions.append(torch.cat([own + read[:, :3], read[:, 3:]], dim=1))
    return torch.stack(predictions[warm_up:])


def test_changes_add_up_in_the_closed_loop() -> None:
    ensemble = random_ensemble(LOG, 0, members=2)
    windows = torch.randn(11, 2, 5, 9, generator=torch.Generator().manual_seed(0))
    ours = predict_windows(ensemble.weight, ensemble.readout, windows, 3, ensemble.feedback)
    theirs = changes_by_loop(ensemble, windows, 3)
    assert ours.shape == (8, 2 * 4, 9)
    # eight recurrent steps in single precision
    torch.testing.assert_close(ours.view(8, 2, 4, 9), theirs, rtol=1e-4, atol=1e-5)


def test_what_networks_read_back() -> None:
    joint = Feedback.of(JOINT, RULE)
    assert joint.reads.tolist() == joint.adds.tolist() == [[1.0, 1.0, 1.0]]
    apart = Feedback.of(dataclasses.replace(JOINT, networks="separate", target="value"), RULE)
    assert apart.reads.tolist() == [[1.0], [1.0], [1.0], [0.0]]
    assert not apart.sums
    machine = DynamicsSpecification.of_card(make_log().card)
    plain = Feedback.of(RecurrentEnsembleConfig(), machine)
    assert plain.reads.tolist() == [[1.0], [0.0]]
    forgetful = RecurrentEnsembleConfig(memoryless=("fatigue", "consumption"))
    assert Feedback.of(forgetful, machine).reads.shape == (2, 0)


def test_separate_networks_of_a_robot_learn_too() -> None:
    config = dataclasses.replace(JOINT, networks="separate", target="value", updates=2)
    fit = fit_recurrent_ensemble(LOG, config, lane_key("apart"), CPU)
    assert fit.model.weight.shape == (4 * 2, 6, 6 + 2 + 1 + 1)
    assert {"validation_mse/reward", "validation_mse/tilt1"} <= set(fit.metrics)


def test_storage(tmp_path: Path) -> None:
    ensemble = random_ensemble(LOG, 0)
    ensemble.save(tmp_path)
    loaded = RecurrentEnsemble.load(tmp_path)
    assert torch.equal(loaded.feedback.adds, ensemble.feedback.adds)
    assert loaded.feedback.sums
    assert (loaded.warm_up, loaded.members) == (3, 3)


def test_training_and_roll_outs_predict_the_same() -> None:
    """The loss's closed loop and the model environment's are one and the same."""
    ensemble = fit_recurrent_ensemble(LOG, JOINT, lane_key("same"), CPU).model
    alone = dataclasses.replace(
        ensemble,
        weight=ensemble.weight[:1],  # a single member leaves no choice
        readout=ensemble.readout[:1],
        low=ensemble.low - 99.0,
        high=ensemble.high + 99.0,
    )
    windows = TrainingWindows(LOG, JOINT, CPU)
    start = windows.train[:7]  # of the first episode, which is long
    inputs, _ = windows.gather(start.expand(2, -1))
    expected = predict_windows(alone.weight, alone.readout, inputs[:, :1], 3, alone.feedback)
    whole = torch.from_numpy(model_frames(LOG, RULE))
    recorded = whole[start[:, None] + 3 - torch.arange(4)][None]
    plain = Normaliser(torch.zeros(1, 3), torch.ones(1, 3))
    virtual = ModelEnvironment(RecurrentTransition([alone], CPU), RULE, plain, CPU)
    actions = iter(whole[start + 3 + t + 1, :2][None] for t in range(8))
    seen = recorded[:, :, 0, 2:5]
    steps = virtual.unroll(seen, recorded, lambda now: next(actions), 8)
    scaling = Normaliser(ensemble.frames.mean[2:], ensemble.frames.scale[2:])
    for step, values in zip(steps, expected, strict=True):
        found = torch.cat([step.frames, step.rewards[..., None]], dim=-1)[0]
        # eight recurrent steps in single precision, scaled and unscaled
        torch.testing.assert_close(scaling.apply(found), values.T, rtol=1e-3, atol=1e-3)
