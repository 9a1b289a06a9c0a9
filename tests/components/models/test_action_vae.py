"""The autoencoder of logged actions: learning, held-out loss, storage, resumption, rescaling."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator, lane_key
from components.core.tensors import save_tensors
from components.data.dataset import OfflineDataset
from components.models import supervised
from components.models.action_vae import (
    ActionReconstruction,
    ActionVAE,
    ActionVAEConfig,
    fit_action_vae,
)
from components.models.supervised import Fit, StackedFit
from tests.components.algorithms.plain import floats, network
from tests.components.interruption import killed_at, save_always
from tests.components.synthetic import (
    CPU,
    FEATURES,
    controller,
    make_log,
    random_action_vae,
    relabelled,
)

LOG = make_log(episodes=5, steps=40)
KEY = lane_key("autoencoder")
SMALL = {"hidden": (7,), "epochs": 2, "batch": 20, "learning_rate": 1e-2}


def fit(log: OfflineDataset = LOG, **changes: Any) -> Fit[ActionVAE]:
    return fit_action_vae(log, ActionVAEConfig(**(SMALL | changes)), KEY, CPU)


def weights(model: ActionVAE) -> dict[str, Tensor]:
    return model.network.state_dict()


def equal(ours: ActionVAE, theirs: ActionVAE) -> bool:
    pairs = zip(weights(ours).values(), weights(theirs).values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


def rebuilt(model: ActionVAE, history: np.ndarray, action: np.ndarray, noise: np.ndarray) -> Any:
    """Mean and log deviation of the latents, and the decoded action, of one raw ``[H, F]``."""
    seen = (history[: model.history] - floats(model.frames.mean)) / floats(model.frames.scale)
    encoded = network(model.network.encoder, 0, np.append(seen.flatten(), action)[None])[0]
    mean, log_std = encoded[:6], np.clip(encoded[6:], -4.0, 15.0)
    latent = mean + np.exp(log_std) * noise
    decoded = network(model.network.decoder, 0, np.append(seen.flatten(), latent)[None])[0]
    return mean, log_std, np.tanh(decoded)


@pytest.mark.slow(1)
def test_the_actions_of_an_operator_are_learned() -> None:
    """On unseen trajectories; an action he would not take comes back as one he would."""
    log = make_log(episodes=20, steps=60, explore=0.0)
    fitted = fit(log, hidden=(32, 32), epochs=30, batch=64, learning_rate=3e-3)
    # two logs measured: 0.0002 and 0.0003 of variances 0.048 and 0.046
    spread = float(log.actions.var(axis=0).mean())
    assert fitted.metrics["validation_reconstruction_error"] < 0.05 * spread
    model = ActionReconstruction([fitted.model], Normaliser.stack([fitted.model.frames]), CPU)
    other = make_log(seed=1, episodes=4, steps=60, explore=0.0)
    rows = other.frame_rows()[other.frame_rows() - other.first_rows() >= 2]
    history = torch.from_numpy(np.stack([other.frames[rows - lag] for lag in range(3)], axis=1))
    seen = fitted.model.frames.apply(history).flatten(1)[None]
    usual = torch.from_numpy(controller(other.frames[rows, 1:4].astype(np.float64))).float()[None]
    errors = [
        float((action - model(seen, action, torch.zeros(1, len(rows), 6))).square().mean())
        for action in (usual, usual - 1.2 * usual.sign())
    ]
    assert errors[0] < 0.005  # measured 0.0001
    assert errors[1] > 0.8 * 1.2**2  # measured 1.442: nothing of the strange action is left


def test_held_out_loss_by_hand() -> None:
    """Mean squared error and half the divergence on the last trajectory, with fixed noise."""
    fitted = fit(hidden=(7, 6))
    rows, first = LOG.frame_rows()[160:], LOG.first_rows()[160:]
    noise = lane_generator(lane_key(KEY, "validation")).standard_normal((1, 40, 6), "f4")[0]
    errors, divergences = [], []
    for number, (row, start) in enumerate(zip(rows, first, strict=True)):
        history = np.stack([LOG.frames[max(row - lag, start)] for lag in range(3)])
        action = LOG.actions[160 + number]
        mean, log_std, decoded = rebuilt(fitted.model, history, action, noise[number])
        errors.append(np.square(decoded - action).mean())
        variance = np.exp(2.0 * log_std)
        divergences.append(0.5 * (variance + mean**2 - 1.0 - np.log(variance)).mean())
    # float32 sums of forty rows
    found = fitted.metrics["validation_reconstruction_error"]
    assert found == pytest.approx(np.mean(errors), rel=1e-4)
    divergence = fitted.metrics["validation_divergence"]
    assert divergence == pytest.approx(np.mean(divergences), rel=1e-4)
    assert fitted.validation_loss == pytest.approx(found + 0.5 * divergence, rel=1e-5)


def test_best_state_is_kept_and_every_epoch_judged() -> None:
    fitted = fit(epochs=30, learning_rate=0.05)
    steps, losses = fitted.curves["model/validation_loss"]
    assert list(steps) == list(range(8, 241, 8)), "160 training rows in batches of 20"
    assert min(losses) < losses[-1], "at so high a rate the last state is not the best"
    assert fitted.validation_loss == pytest.approx(min(losses), rel=1e-6)


def test_held_out_trajectories_are_never_trained_on() -> None:
    changed = make_log(episodes=5, steps=40)
    changed.actions[4 * 40 :] *= -1.0  # holdout 0.1 of five trajectories: the last one
    changed.frames[4 * 41 :] += 30.0
    ours, theirs = fit(epochs=1), fit(relabelled(changed), epochs=1)
    assert equal(ours.model, theirs.model)
    assert torch.equal(ours.model.frames.mean, theirs.model.frames.mean)
    assert torch.equal(ours.model.frames.scale, theirs.model.frames.scale)
    assert ours.validation_loss != theirs.validation_loss


def test_frames_are_scaled_by_the_training_trajectories() -> None:
    scaling = fit(epochs=1).model.frames
    seen = LOG.frames[: 4 * 41].astype(np.float64)
    # float32 of a double's mean and deviation
    np.testing.assert_allclose(scaling.mean, seen.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(scaling.scale[1:], seen.std(axis=0)[1:], rtol=1e-6)
    assert scaling.scale[0] == 1.0, "the setpoint never moves"


@pytest.mark.parametrize("deaths", [[0], [11], [10, 12], [13, 15]])
def test_interrupted_equals_uninterrupted(
    deaths: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_always(monkeypatch, supervised)
    config = ActionVAEConfig(**(SMALL | {"schedule": "cosine"}))

    def resumable(checkpoint: Path | None) -> Fit[ActionVAE]:
        return fit_action_vae(LOG, config, KEY, CPU, checkpoint)

    expected = resumable(None)
    found = killed_at(deaths, StackedFit, resumable, tmp_path / "c", monkeypatch)
    assert equal(found.model, expected.model)
    assert found.metrics == expected.metrics
    assert found.curves == expected.curves


def test_storage_keeps_everything(tmp_path: Path) -> None:
    made = fit(history=2, hidden=(7, 6)).model
    made.save(tmp_path)
    assert [path.suffix for path in tmp_path.iterdir()] == [".safetensors"]
    stored = ActionVAE.load(tmp_path)
    assert equal(stored, made)
    assert (stored.history, stored.hidden) == (2, (7, 6))
    assert torch.equal(stored.frames.mean, made.frames.mean)
    assert torch.equal(stored.frames.scale, made.frames.scale)
    assert not any(p.requires_grad for p in stored.network.parameters())


def test_other_files_are_refused(tmp_path: Path) -> None:
    save_tensors(tmp_path / "autoencoder.safetensors", {"x": torch.zeros(1)}, {"format": "other"})
    with pytest.raises(ValueError, match=r"holds 'other', expected 'action-vae/1'\."):
        ActionVAE.load(tmp_path)
    (tmp_path / "autoencoder.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is damaged or was not written by this project"):
        ActionVAE.load(tmp_path)


def inputs(lanes: int, batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """Raw histories ``[L, N, 3, F]``, actions and noise."""
    g = torch.Generator().manual_seed(0)
    raw = torch.from_numpy(LOG.frames[: 3 * lanes * batch].reshape(lanes, batch, 3, 6).copy())
    actions = torch.rand(lanes, batch, 3, generator=g) * 2.0 - 1.0
    return raw, actions, torch.randn(lanes, batch, 6, generator=g)


def test_policies_in_any_scaling_get_the_same_actions_back() -> None:
    """Two lanes, each with its own weights, own scaling and a policy's scaling."""
    models = [random_action_vae(LOG, name) for name in "ab"]
    shifted = Normaliser(models[1].frames.mean - 7.0, 0.2 * models[1].frames.scale)
    models[1] = dataclasses.replace(models[1], frames=shifted)
    raw, actions, noise = inputs(2, 5)
    ends = []
    for mean, scale in ((0.0, 1.0), (40.0, 12.0)):
        given = Normaliser(torch.full((2, 6), mean), torch.full((2, 6), scale))
        given.scale[1] *= 3.0
        seen = ((raw - given.mean[:, None, None]) / given.scale[:, None, None]).flatten(2)
        ends.append(ActionReconstruction(models, given, CPU)(seen, actions, noise))
    # frames near 100 in units of 1: float32 cancels two digits
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-3, atol=1e-4)
    for lane, n in itertools.product(range(2), range(5)):
        *_, expected = rebuilt(models[lane], raw[lane, n].numpy(), *(
            floats(t)[lane, n] for t in (actions, noise)
        ))  # fmt: skip
        np.testing.assert_allclose(ends[1][lane, n], expected, rtol=1e-3, atol=1e-4)
    assert float((ends[1][0] - ends[1][1]).abs().max()) > 0.01, "lanes have different models"


def test_only_the_newest_frames_are_read() -> None:
    model = random_action_vae(LOG, "two frames")
    made = ActionReconstruction([model], Normaliser.stack([model.frames]), CPU)
    seen, actions, noise = torch.randn(1, 4, 18), torch.zeros(1, 4, 3), torch.zeros(1, 4, 6)
    before = made(seen, actions, noise)
    for entry, matters in ((0, True), (11, True), (12, False), (17, False)):
        changed = seen.clone()
        changed[..., entry] += 5.0
        assert torch.equal(made(changed, actions, noise), before) != matters


def test_gradients_reach_observations_and_actions_but_no_weight() -> None:
    model = random_action_vae(LOG, "g")
    made = ActionReconstruction([model], Normaliser.stack([model.frames]), CPU)
    made._network.double()
    g = torch.Generator().manual_seed(0)
    seen, actions, noise = (
        torch.randn(1, 3, width, generator=g, dtype=torch.float64) for width in (18, 3, 6)
    )
    seen.requires_grad_()
    actions.requires_grad_()

    def total(x: Tensor, a: Tensor) -> Tensor:
        return (a - made(x, a, noise)).square().sum()

    gradients = torch.autograd.grad(total(seen, actions), (seen, actions))
    assert not any(p.requires_grad for p in made._network.parameters())
    assert torch.equal(gradients[0][..., 12:], torch.zeros(1, 3, 6, dtype=torch.float64))
    for number, point in enumerate((seen, actions)):
        direction = torch.randn(point.shape, generator=g, dtype=torch.float64)
        ends = []
        for sign in (1e-6, -1e-6):
            moved = [seen, actions]
            moved[number] = point + sign * direction
            ends.append(total(*moved).item())
        slope = (gradients[number] * direction).sum().item()
        assert abs(slope) > 1e-2
        # central difference in double precision
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(
    "changes",
    [
        {"hidden": (9,)},
        {"learning_rate": 3e-3},
        {"schedule": "cosine"},
        {"weight_decay": 0.1},
        {"epochs": 3},
        {"batch": 19},
        {"holdout": 0.4},
        {"history": 1},
    ],
)
def test_every_setting_counts(changes: dict[str, Any]) -> None:
    ours, theirs = weights(fit().model), weights(fit(**changes).model)
    assert any(
        ours[name].shape != theirs[name].shape or not torch.equal(ours[name], theirs[name])
        for name in ours
    )


def test_history_is_counted_in_frames() -> None:
    for history, frames in ((0, 3), (3, 3), (1, 1)):
        model = fit(epochs=1, history=history).model
        assert model.history == frames
        assert weights(model)["encoder.layers.0.weight"].shape[1] == frames * len(FEATURES) + 3
    with pytest.raises(ValueError, match=r"history is 4, but observations of toy have 3 frames"):
        fit(history=4)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("hidden", (750, 0)),
        ("epochs", 0),
        ("batch", 0),
        ("history", -1),
        ("learning_rate", 0.0),
        ("weight_decay", -1e-3),
        ("holdout", 1.0),
        ("schedule", "stairs"),
    ],
)
def test_values_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"{field}.*\.$"):
        ActionVAEConfig(**{field: value})
