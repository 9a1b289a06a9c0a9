"""Fits a model by its name and stores it, refusing one that is not finite."""

import math
from pathlib import Path
from typing import Any

import torch

from components.core.random_streams import lane_key
from components.core.tensors import load_tensors
from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.models.supervised import UNWATCHED, Fit, Monitor
from components.training.divergence import DivergedError

__all__ = ["fit_into"]


def fit_into(
    folder: Path,
    name: str,
    dataset: OfflineDataset,
    config: Any,
    seed: int,
    *,
    device: torch.device,
    checkpoint: Path,
    monitor: Monitor = UNWATCHED,
) -> Fit[Any]:
    """Fit a model and store it.

    Args:
        folder: To be made and filled with the model.
        name: In :data:`components.models.MODELS`.
        dataset: What to fit it to; its random stream is that of (dataset, model, seed).
        config: Its configuration object.
        seed: Of the fit.
        device: Where to compute.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out loss.

    Raises:
        DivergedError: Its loss, or anything stored of the model, is not finite.
    """
    key = lane_key(dataset.card.name, name, seed)
    fit = MODELS[name].fit(dataset, config, key, device, checkpoint, monitor)
    folder.mkdir(parents=True)
    fit.model.save(folder)
    if not math.isfinite(fit.validation_loss):
        raise DivergedError(f"its held-out loss is {fit.validation_loss}")
    for file in sorted(folder.glob("*.safetensors")):
        tensors, _ = load_tensors(file)
        if wrong := [n for n, tensor in tensors.items() if not tensor.isfinite().all()]:
            raise DivergedError(f"the model is not finite in {', '.join(wrong)}")
    return fit
