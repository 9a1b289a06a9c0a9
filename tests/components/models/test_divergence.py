"""Fits of every kind that diverge: nothing is fitted, or the best finite state is."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.core.tensors import load_tensors
from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.models.supervised import Fit
from components.training.divergence import DivergedError
from tests.components.synthetic import CPU, make_log, relabelled

LOG = make_log("plant", episodes=6, steps=60)
ENSEMBLE: dict[str, Any] = {"members": 2, "hidden": (8,), "epochs": 3, "batch": 64}
SMALL: dict[str, dict[str, Any]] = {
    "behaviour_policy": {"epochs": 3, "batch": 32},
    "gaussian_behaviour": {"epochs": 3, "batch": 32, "hidden": (8,)},
    "action_vae": {"epochs": 3, "batch": 32, "hidden": (8, 8)},
    "deterministic_ensemble": ENSEMBLE,
    "gaussian_ensemble": ENSEMBLE | {"elites": 1},
    "residual_ensemble": ENSEMBLE,
    "recurrent_ensemble": {
        "members": 2, "hidden": 5, "warm_up": 5, "horizon": 5, "updates": 20, "batch": 8,
        "validate_every": 10,
    },
}  # fmt: skip


def fit(model: str, log: OfflineDataset, **changes: Any) -> Fit[Any]:
    kind = MODELS[model]
    return kind.fit(log, kind.config(**(SMALL[model] | changes)), 5, CPU)


def assert_finite(fitted: Fit[Any], folder: Path) -> None:
    assert math.isfinite(fitted.validation_loss)
    fitted.model.save(folder)
    for file in folder.glob("*.safetensors"):
        for name, tensor in load_tensors(file)[0].items():
            assert tensor.isfinite().all(), name


def test_every_kind_is_here() -> None:
    assert SMALL.keys() == MODELS.keys()


@pytest.mark.parametrize("model", MODELS)
def test_a_rate_far_out_of_range(model: str, tmp_path: Path) -> None:
    if model == "behaviour_policy":  # its tanh saturates: a bad policy, and a finite one
        # Its products stay within single precision; beyond, processors differ in what is undefined.
        saturated = fit(model, LOG, learning_rate=1e15)
        assert_finite(saturated, tmp_path)
        assert saturated.validation_loss > saturated.metrics["training/untrained_loss"]
    deeper = {"hidden": (8, 8, 8)} if model == "behaviour_policy" else {}
    with pytest.raises(DivergedError, match=r"^its held-out loss was never finite$"):
        fit(model, LOG, learning_rate=1e30, **deeper)


@pytest.mark.parametrize("model", MODELS)
def test_a_fit_that_stays_finite_says_nothing(model: str, tmp_path: Path) -> None:
    fitted = fit(model, LOG)
    assert fitted.ended_at is None
    assert "training/untrained_loss" not in fitted.metrics
    assert_finite(fitted, tmp_path)


@pytest.mark.parametrize("model", MODELS)
def test_a_rate_of_nearly_nothing_learns_nothing(model: str) -> None:
    metrics = fit(model, LOG, learning_rate=1e-30).metrics
    assert metrics["training/untrained_loss"] > 0


@pytest.mark.parametrize("model", MODELS)
def test_a_poisoned_log(model: str) -> None:
    frames = LOG.frames.copy()
    frames[3, 4] = np.nan
    with pytest.raises(DivergedError, match=r"^its held-out loss was never finite$"):
        fit(model, relabelled(LOG, frames=frames))


def test_of_two_target_forms_the_one_that_did_not_diverge_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from components.models.mlp_ensemble import fit as module

    held_out = module._Losses.held_out

    def undefined_values(self: Any, network: Any) -> Any:
        errors, nll = held_out(self, network)
        errors[0] = math.nan  # the first member of the first form
        return errors, nll

    monkeypatch.setattr(module._Losses, "held_out", undefined_values)
    fitted = fit("deterministic_ensemble", LOG)
    assert fitted.model.target == "change"
    assert fitted.ended_at is None
    assert math.isinf(fitted.metrics["validation_mse/value"])
