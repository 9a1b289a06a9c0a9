"""Training of the recurrent transition ensemble, all networks at once.

Training unrolls G + F steps from a zero hidden state. During the first G steps, and at the first
predicted one, the fatigue network is fed the recorded value; from then on its own prediction,
unclipped. The loss is the mean squared error over the F predicted steps (thesis 6.2, eq. 3.41).

All 2K networks are lanes of one stack ``[2K, ...]``, fatigue networks first, each with its own
window stream and its own best held-out state.

Deviations from the thesis (its learning rate 1.25e-5 cannot train these networks, and it names a
delta target; the published checkpoints agree with what is done here): Adam with a one-cycle
learning rate instead of a plateau schedule, which reaches the same error in a fraction of the
updates; smaller batches; no weight decay; gradients limited in norm, network by network.
"""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from components.data.dataset import OfflineDataset
from components.data.normaliser import Normaliser
from components.data.splits import split_episodes
from components.models.recurrent_ensemble import (
    RecurrentEnsemble,
    RecurrentEnsembleConfig,
    predict_windows,
)
from components.models.rollout import INPUTS, TARGETS
from components.models.supervised import UNWATCHED, Fit, Monitor
from components.networks import LaneStreams, lane_key, spawn_generators
from components.networks.checkpoint import (
    load_optimizer_state,
    optimizer_state,
    prefixed,
    with_prefix,
)
from components.networks.training import Curves, TrainingLoop, adam

__all__ = ["fit_recurrent_ensemble"]


class _Windows:
    """Windows of normalised frames, gathered on the device for every network."""

    def __init__(
        self, dataset: OfflineDataset, config: RecurrentEnsembleConfig, device: torch.device
    ) -> None:
        features = dataset.card.frame_features
        if tuple(features) != (*INPUTS, *TARGETS):
            raise ValueError(
                f"The recurrent ensemble needs frames of {(*INPUTS, *TARGETS)}, "
                f"but {dataset.card.name} logs {tuple(features)}."
            )
        split = split_episodes(dataset, config.holdout)
        train, held_out = split.train, split.held_out
        length = config.warm_up + config.horizon
        self.length = length
        starts = dataset.episode_starts
        # Frame row of a window's start: transition row plus one extra frame per earlier episode.
        rows = [
            np.arange(starts[e] + e, starts[e + 1] + e - length + 1) for e in range(len(starts) - 1)
        ]
        short = [e for e, r in enumerate(rows) if not len(r)]
        if short:
            raise ValueError(
                f"Trajectory {short[0]} of {dataset.card.name} is shorter than warm_up + horizon "
                f"= {length} steps; shorten these."
            )
        self.train = torch.from_numpy(np.concatenate([rows[e] for e in train])).to(device)
        self.held_out = torch.from_numpy(np.concatenate([rows[e] for e in held_out])).to(device)
        last = int(starts[train[-1] + 1] + train[-1] + 1)
        seen = np.asarray(dataset.frames[:last])
        self.normaliser = Normaliser.fit(seen)
        scaled = self.normaliser.apply(torch.from_numpy(np.array(dataset.frames)))
        targets = scaled[:last, len(INPUTS) :]
        self.low, self.high = targets.amin(dim=0), targets.amax(dim=0)
        self._table = scaled.T.contiguous().to(device)  # [6, rows]
        self._steps = torch.arange(length, device=device).view(-1, 1, 1, 1)
        members = config.members
        target = torch.arange(2 * members, device=device) // members + len(INPUTS)  # [M]
        inputs = torch.arange(len(INPUTS), device=device).view(1, 1, -1, 1)
        self._inputs = inputs * self._table.shape[1]
        self._target = (target * self._table.shape[1]).view(1, -1, 1, 1)
        self._feeds_back = (target == len(INPUTS)).view(1, -1, 1, 1)
        self._target_offset = target * self._table.shape[1]
        self._horizon = config.horizon

    def gather(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs ``[G + F, M, 5, B]`` and targets ``[F, M, B]`` of windows ``start [M, B]``."""
        rows = start[None, :, None, :] + self._steps  # [T, M, 1, B]
        steerings = torch.take(self._table, rows + 1 + self._inputs)
        own = torch.take(self._table, rows + self._target) * self._feeds_back
        future = start[None] + self._steps[-self._horizon :, :, 0] + 1
        targets = torch.take(self._table, future + self._target_offset[None, :, None])
        return torch.cat([steerings, own], dim=2), targets


class _EnsembleLearner:
    """Adapter of the ensemble to the common training loop."""

    def __init__(
        self, windows: _Windows, config: RecurrentEnsembleConfig, key: int, device: torch.device
    ) -> None:
        self._config, self._windows = config, windows
        self.lanes = 2 * config.members
        keys = [lane_key(key, target, k) for target in TARGETS for k in range(config.members)]
        width = config.hidden
        # PyTorch's RNN initialisation: everything uniform in +-1/sqrt(hidden).
        drawn = [
            (g.uniform(-1, 1, (width, width + 6)), g.uniform(-1, 1, (1, width + 1)))
            for g in spawn_generators(keys, "weights")
        ]
        bound = width**-0.5
        weight = torch.from_numpy(np.stack([w for w, _ in drawn]) * bound).float().to(device)
        readout = torch.from_numpy(np.stack([r for _, r in drawn]) * bound).float().to(device)
        # Consumption networks have no self-input; as it is multiplied by zero in every window,
        # the column stays at zero in the closed loop too.
        weight[config.members :, :, width + len(INPUTS)] = 0.0
        self.best_weight, self.best_readout = weight.clone(), readout.clone()
        self.weight, self.readout = weight.requires_grad_(), readout.requires_grad_()
        self.best_loss = torch.full((self.lanes,), math.inf, device=device)
        self.stale = torch.zeros(self.lanes, device=device)
        self._optimizer = adam(
            [self.weight, self.readout], config.learning_rate, config.weight_decay
        )
        count = len(windows.train)
        self._streams = LaneStreams(
            keys,
            {"start": lambda g, lane, steps: g.integers(count, size=(steps, config.batch))},
            device,
        )

    def _rate(self, step: int) -> float:
        """One cycle: linear rise to the peak, cosine fall to zero."""
        rise = max(1, round(self._config.warm_fraction * self._config.updates))
        if step < rise:
            return self._config.learning_rate * (step + 1) / rise
        passed = (step - rise) / max(1, self._config.updates - rise)
        return self._config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * passed))

    def update(self, step: int) -> dict[str, Tensor]:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate(step)
        start = self._windows.train[self._streams.at(step)["start"]]
        inputs, targets = self._windows.gather(start)
        predictions = predict_windows(self.weight, self.readout, inputs, self._config)
        loss = (predictions - targets).square().mean(dim=(0, 2))
        self._optimizer.zero_grad(set_to_none=True)
        loss.sum().backward()
        self._clip()
        self._optimizer.step()
        return {"model/train_mse": loss.detach()}

    def _clip(self) -> None:
        """Limit every network's gradient norm on its own, so that lanes stay independent."""
        grads = [g for g in (self.weight.grad, self.readout.grad) if g is not None]
        norm = torch.stack([g.flatten(1).norm(dim=1) for g in grads]).norm(dim=0)
        factor = (self._config.clip_norm / norm.clamp(min=1e-12)).clamp(max=1.0)
        for grad in grads:
            grad.mul_(factor[:, None, None])

    @torch.no_grad()
    def validation_loss(self, weight: Tensor, readout: Tensor, stride: int) -> Tensor:
        """Held-out normalised mean squared error per network, ``[2K]``."""
        starts = self._windows.held_out[::stride]
        total = torch.zeros(self.lanes, device=starts.device)
        for part in starts.split(512):
            inputs, targets = self._windows.gather(part.expand(self.lanes, -1))
            predictions = predict_windows(weight, readout, inputs, self._config)
            total += (predictions - targets).square().mean(dim=0).sum(dim=1)
        return total / len(starts)

    def keep_best(self, losses: Tensor) -> None:
        """Remember every network's weights where its own held-out loss was lowest."""
        better = losses < self.best_loss
        self.best_loss = torch.where(better, losses, self.best_loss)
        self.stale = torch.where(better, torch.zeros_like(self.stale), self.stale + 1)
        chosen = better[:, None, None]
        self.best_weight = torch.where(chosen, self.weight.detach(), self.best_weight)
        self.best_readout = torch.where(chosen, self.readout.detach(), self.best_readout)

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "weight": self.weight.detach(),
            "readout": self.readout.detach(),
            "best_weight": self.best_weight,
            "best_readout": self.best_readout,
            "best_loss": self.best_loss,
            "stale": self.stale,
        }

    def state_dict(self) -> dict[str, Tensor]:
        return self._tensors() | prefixed("optimizer", optimizer_state(self._optimizer))

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])
        load_optimizer_state(self._optimizer, with_prefix("optimizer", state))


def fit_recurrent_ensemble(
    dataset: OfflineDataset,
    config: RecurrentEnsembleConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[RecurrentEnsemble]:
    """Train all networks of the ensemble at once, with early stopping on held-out trajectories.

    Args:
        dataset: Frames must be (setpoint, velocity, gain, shift, fatigue, consumption).
        config: Architecture and schedule.
        key: Random stream, see :func:`components.networks.lane_key`.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Told the progress and the held-out losses.

    Returns:
        The ensemble of best held-out states and the held-out normalised mean squared errors of its
        networks over all held-out windows; the validation loss is their mean.
    """
    windows = _Windows(dataset, config, device)
    learner = _EnsembleLearner(windows, config, key, device)
    names = [f"{target}{k}" for target in TARGETS for k in range(config.members)]

    def validate(done: int, curves: Curves) -> bool:
        if done % config.validate_every and done != config.updates:
            return False
        losses = learner.validation_loss(learner.weight, learner.readout, stride=5)
        curves.add(done, {"model/validation_mse": losses})
        learner.keep_best(losses)
        monitor.validated(done / config.updates, float(losses.mean()))
        return bool((learner.stale >= config.patience).all())

    loop = TrainingLoop(config.updates, names, checkpoint, progress=monitor.progress)
    curves = loop.run(learner, validate)
    final = learner.validation_loss(learner.best_weight, learner.best_readout, stride=1)
    metrics = {f"validation_mse/{name}": float(v) for name, v in zip(names, final, strict=True)}
    for target, values in zip(TARGETS, final.view(len(TARGETS), -1), strict=True):
        metrics[f"validation_mse/{target}"] = float(values.mean())
    ensemble = RecurrentEnsemble(
        learner.best_weight.cpu(),
        learner.best_readout.cpu(),
        windows.normaliser,
        windows.low,
        windows.high,
    )
    by_network = {
        f"{metric}/{name}": series
        for lane, name in enumerate(names)
        for metric, series in curves.of_lane(lane).items()
    }
    return Fit(ensemble, float(final.mean()), metrics, by_network)
