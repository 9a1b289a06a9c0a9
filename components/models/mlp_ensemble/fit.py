"""Training of the one-step ensembles, all members and target forms as lanes of one stack.

From a transition's last frames and the known features of the next model frame, which follow from
the action exactly, a member predicts the learned ones. Learned features that policies do not see (a
robot's reward) are predicted as values in both target forms. Every terminal state adds a transition
from itself to itself, so that members learn that it is absorbing
(:mod:`components.data.absorbing_states`). Where the data choose the target form (thesis 5.1: value
or change, whichever has the lower error on held-out trajectories), both are trained from the same
random streams and the ensemble of lower held-out error is kept. That error is the mean square in
normalised feature units, of the mean prediction in the case of Gaussian members, so that forms and
kinds can be compared.

Deterministic members minimise the mean squared error of standardised targets; Gaussian members
(MOPO's code) ``mean[(mean - y)^2 / var + log var] + 0.01 sum(high) - 0.01 sum(low)``, with learned
bounds of the log variances. Weight decay enters the loss as ``decay / 2 |W|^2``.

Deviations: batches are drawn with replacement; outputs of Gaussian members are standardised, so
that their uncertainties have the same unit; initial weights are PyTorch's for all kinds;
deterministic members too keep the state of their lowest held-out error.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from components.core.draws import Choice
from components.core.normaliser import Normaliser
from components.core.random_streams import LaneStreams, lane_key, spawn_generators
from components.data.absorbing_states import with_absorbing_states
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification, model_frames
from components.data.splits import split_episodes
from components.models.mlp_ensemble.config import MLPEnsembleConfig
from components.models.mlp_ensemble.ensemble import ACTIVATIONS, MLPEnsemble, bounded_log_variance
from components.models.supervised import (
    UNWATCHED,
    Fit,
    Monitor,
    StackedFit,
    ended_at,
    nothing_learned,
)
from components.networks import StackedMLP, lanewise_mean
from components.networks.weight_norm import WeightNormMLP

__all__ = ["fit_mlp_ensemble"]

LOG_VARIANCE = (-10.0, 0.5)  # bounds at the start
BOUND_WEIGHT = 0.01  # of the bounds in the loss
VALIDATION_CHUNK = 2048  # transitions at once, which limits the memory


class _Transitions:
    """Inputs and targets of the network for all lanes, scaled by the training trajectories."""

    def __init__(
        self, dataset: OfflineDataset, config: MLPEnsembleConfig, device: torch.device
    ) -> None:
        dynamics = DynamicsSpecification.of_card(dataset.card)
        self.names, self.observed, known = dynamics.learned, dynamics.observed, len(dynamics.known)
        whole = with_absorbing_states(dataset.with_history(config.history), 1)
        self.history = whole.card.history
        split = split_episodes(dataset, config.holdout)
        self.trained = split.trained_transitions(whole)
        self.held_out = torch.arange(self.trained, whole.transitions, device=device)
        logged = split.trained_transitions(dataset)
        seen = np.array(model_frames(dataset, dynamics)[: split.trained_frames(dataset)])
        self.scaling = Normaliser.fit(seen)
        targets = self.scaling.apply(torch.from_numpy(seen))[:, known:]
        self.low, self.high = targets.amin(dim=0), targets.amax(dim=0)
        rows = dataset.frame_rows()[:logged]
        changes = Normaliser.fit((targets[rows + 1] - targets[rows]).numpy())
        shown = torch.tensor(dynamics.shown)
        moments = {
            "value": Normaliser(torch.zeros(len(shown)), torch.ones(len(shown))),
            "change": Normaliser(
                torch.where(shown, changes.mean, 0.0), torch.where(shown, changes.scale, 1.0)
            ),
        }
        self.moments = [moments[form] for form in config.forms]
        lanes = len(config.forms) * config.members
        of_frames = slice(*dynamics.observed)
        scaling = Normaliser(self.scaling.mean[of_frames], self.scaling.scale[of_frames])
        self._data = LaneData([whole] * lanes, device, scaling=lambda _: scaling)
        table = self.scaling.apply(torch.from_numpy(np.array(model_frames(whole, dynamics))))
        self._known, self._learned = (
            part.contiguous().to(device) for part in table.split([known, len(shown)], dim=1)
        )
        self._rows = torch.from_numpy(whole.frame_rows()).to(device)  # of the newest frames
        stacked = Normaliser.stack([m for m in self.moments for _ in range(config.members)]).to(
            device
        )
        self.inputs = self._data.observation_width + known
        self.mean, self.scale = stacked.mean[:, None], stacked.scale[:, None]  # [L, 1, D]
        changing = [form == "change" for form in config.forms for _ in range(config.members)]
        self._changes = (torch.tensor(changing)[:, None, None] & shown).float().to(device)

    def gather(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs ``[L, B, H * F + known]`` and standardised targets ``[L, B, D]``."""
        before = self._rows[index]
        after = before + 1
        inputs = torch.cat([self._data.observations(index), self._known[after]], dim=-1)
        targets = self._learned[after] - self._changes * self._learned[before]
        return inputs, (targets - self.mean) / self.scale


class _Network(nn.Module):
    """The stack of members, and the bounds of the log variances of Gaussian ones."""

    def __init__(
        self, keys: list[int], inputs: int, targets: int, config: MLPEnsembleConfig
    ) -> None:
        super().__init__()
        outputs = targets * (2 if config.gaussian else 1)
        stack = WeightNormMLP if config.weight_norm else StackedMLP
        self.stack = stack(
            spawn_generators(keys, "weights"),
            (inputs, *config.hidden, outputs),
            ACTIVATIONS[config.activation],
        )
        bounds = torch.tensor(LOG_VARIANCE)[None, :, None]
        self.bounds = (
            nn.Parameter(bounds.expand(len(keys), -1, targets).clone())  # [L, 2, D]
            if config.gaussian
            else None
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Means and log variances ``[L, B, D]`` of standardised targets."""
        out = self.stack(x)
        if self.bounds is None:
            return out, None
        mean, raw = out.chunk(2, dim=-1)
        return mean, bounded_log_variance(raw, self.bounds[:, :1], self.bounds[:, 1:])


@dataclass(frozen=True)
class _Losses:
    """Training and held-out losses ``[L]`` of a network."""

    data: _Transitions
    decays: tuple[float, ...]

    def training(
        self, network: _Network, drawn: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of a batch, and the squared error in it."""
        inputs, targets = self.data.gather(drawn["row"])
        mean, log_variance = network(inputs)
        errors = (mean - targets).square()
        loss = lanewise_mean(_likelihood(errors, log_variance))
        if network.bounds is not None:
            loss = loss + BOUND_WEIGHT * (network.bounds[:, 1] - network.bounds[:, 0]).sum(dim=1)
        if any(self.decays):
            for (weight, _), decay in zip(network.stack.affine(), self.decays, strict=True):
                loss = loss + 0.5 * decay * weight.square().sum(dim=(1, 2))
        return loss, {"model/train_mse": lanewise_mean(errors.detach())}

    @torch.no_grad()
    def held_out(self, network: _Network) -> tuple[Tensor, Tensor]:
        """Mean squared errors ``[L, D]``, and negative log densities a target ``[L]``."""
        scale = self.data.scale
        errors = torch.zeros_like(scale[:, 0])
        likelihood = torch.zeros_like(errors)
        for rows in self.data.held_out.split(VALIDATION_CHUNK):
            inputs, targets = self.data.gather(rows.expand(len(scale), -1))
            mean, log_variance = network(inputs)
            squares = (mean - targets).square()
            errors += (squares * scale.square()).sum(dim=1)
            likelihood += _likelihood(squares, log_variance).sum(dim=1)
        count = len(self.data.held_out)
        nll = 0.5 * (likelihood / count + math.log(2.0 * math.pi)) + scale[:, 0].log()
        return errors / count, nll.mean(dim=1)


def _likelihood(squares: Tensor, log_variance: Tensor | None) -> Tensor:
    """Twice the negative log density up to a constant; without a variance, the squared error."""
    if log_variance is None:
        return squares
    return squares * torch.exp(-log_variance) + log_variance


def fit_mlp_ensemble(
    dataset: OfflineDataset,
    config: MLPEnsembleConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[MLPEnsemble]:
    """Train all members at once.

    Args:
        dataset: A log whose card has a dynamics specification.
        config: Architecture and schedule; its class is the kind of ensemble.
        key: Random stream, see :func:`components.core.random_streams.lane_key`.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out losses.

    Returns:
        The ensemble of the members' best held-out states, its held-out mean squared error in
        normalised units averaged over members and targets, and as metrics the error's parts.

    Raises:
        DivergedError: A network never had a finite state of finite held-out loss.
    """
    data = _Transitions(dataset, config, device)
    forms, members = config.forms, config.members
    names = [f"{form}{k}" for form in forms for k in range(members)]
    # Members of both forms use the same random streams, so that the forms differ in nothing else.
    keys = [lane_key(key, k) for _ in forms for k in range(members)]
    losses = _Losses(data, config.decays)
    network = _Network(keys, data.inputs, len(data.names), config).to(device)
    fitting = StackedFit(
        network,
        len(names),
        losses.training,
        _batches(keys, data.trained, config, device),
        learning_rate=config.learning_rate,
        schedule=config.schedule,
    )
    per_epoch = max(1, data.trained // config.batch)

    def of_better_form(of_lanes: Tensor) -> Tensor:
        return of_lanes.view(len(forms), members).mean(dim=1).amin()

    curves = fitting.run(
        lambda network: losses.held_out(network)[0].mean(dim=1),
        names,
        updates=config.epochs * per_epoch,
        validate_every=per_epoch,
        patience=config.patience or None,
        improvement=config.improvement,
        overall=of_better_form,
        checkpoint=checkpoint,
        monitor=monitor,
    )
    errors, nll = losses.held_out(fitting.best)
    of_forms = errors.view(len(forms), -1).mean(dim=1)
    # A form of which a member never had a finite loss has no ensemble to choose.
    whole = fitting.best_loss.isfinite().view(len(forms), members).all(dim=1)
    of_forms = torch.where(whole, of_forms, torch.inf)
    chosen = int(of_forms.argmin())
    lanes = slice(chosen * members, (chosen + 1) * members)
    ended = ended_at(curves, fitting.best_loss, lanes)
    metrics = {f"validation_mse/{form}": float(e) for form, e in zip(forms, of_forms, strict=True)}
    own = errors[lanes]  # [K, D]
    of_targets = zip(data.names, own.mean(dim=0), strict=True)
    metrics |= {f"validation_mse/{target}": float(error) for target, error in of_targets}
    metrics |= {f"validation_mse/member{k}": float(e) for k, e in enumerate(own.mean(dim=1))}
    metrics |= nothing_learned(fitting.best_loss[lanes], fitting.untrained_loss[lanes])
    if config.gaussian:
        metrics["validation_nll"] = float(nll[lanes].mean())
    by_member = {
        f"{metric}/{name}": series
        for lane, name in enumerate(names)
        for metric, series in curves.of_lane(lane).items()
    }
    ensemble = _artifact(fitting.best, data, config, chosen, own.mean(dim=1))
    return Fit(ensemble, float(of_forms[chosen]), metrics, by_member, ended)


def _batches(
    keys: list[int], trained: int, config: MLPEnsembleConfig, device: torch.device
) -> LaneStreams:
    """Batches of training transitions, drawn from each member's bootstrap sample if it has one."""
    resampled = [
        g.integers(trained, size=trained) if config.bootstrap else np.arange(trained)
        for g in spawn_generators(keys, "bootstrap")
    ]
    return LaneStreams(keys, {"row": Choice(resampled, config.batch)}, device)


def _artifact(
    network: _Network, data: _Transitions, config: MLPEnsembleConfig, form: int, errors: Tensor
) -> MLPEnsemble:
    """The members of a form, and their ranking by ``errors [K]``."""
    lanes = slice(form * config.members, (form + 1) * config.members)
    bounds = torch.empty(0) if network.bounds is None else network.bounds.detach()[lanes]
    ranking = errors.argsort(stable=True)[: config.elites or config.members]
    return MLPEnsemble(
        layers=tuple(
            (weight.detach()[lanes].cpu().clone(), bias.detach()[lanes].cpu().clone())
            for weight, bias in network.stack.affine()
        ),
        frames=data.scaling,
        observed=data.observed,
        low=data.low,
        high=data.high,
        target_mean=data.moments[form].mean,
        target_scale=data.moments[form].scale,
        log_variance=bounds.cpu().clone(),
        history=data.history,
        activation=config.activation,
        target=config.forms[form],
        elites=tuple(int(k) for k in ranking),
    )
