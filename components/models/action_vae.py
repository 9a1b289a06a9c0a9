"""The generative model of the logged actions: a conditional variational autoencoder (thesis 5.1).

It learns to reconstruct an action from a few latent numbers and the state it was taken in. The
reconstruction error is large for actions and states unlike the logged ones; MOOSE penalises its
policy by it. Loss and clamps are BCQ's, see :mod:`components.networks.variational`; sizes and
schedule are the thesis's (5.1.2: 750-750 both ways, Adam 1e-4, batches of 500, 50 epochs).

The last trajectories are held out, and the state of lowest held-out loss is kept. The latents of
every held-out row are drawn once, from the model's own stream, so that two validations differ in
the network alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.core.draws import Integers, Normal
from components.core.normaliser import Normaliser
from components.core.random_streams import LaneStreams, lane_generator, lane_key
from components.core.tensors import load_tensors, save_tensors
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.splits import split_episodes
from components.models.rescaling import read_in_scaling
from components.models.supervised import (
    SCHEDULES,
    UNWATCHED,
    Fit,
    Monitor,
    StackedFit,
    ended_at,
    nothing_learned,
)
from components.networks.variational import ConditionalVAE

__all__ = ["ActionReconstruction", "ActionVAE", "ActionVAEConfig", "fit_action_vae"]

FORMAT = "action-vae/1"
FILE = "autoencoder.safetensors"
VALIDATED_AT_ONCE = 2048


@dataclass(frozen=True, kw_only=True)
class ActionVAEConfig:
    """How the autoencoder is built and trained (thesis 5.1.2)."""

    hidden: tuple[int, ...] = (750, 750)  # layers of encoder and decoder
    history: int = 0  # newest frames read; 0 reads all of an observation
    epochs: int = 50  # passes over the training transitions
    batch: int = 500  # transitions per update
    learning_rate: float = 1e-4  # Adam
    schedule: str = "constant"  # of the learning rate; or cosine
    weight_decay: float = 0.0  # L2 term inside Adam
    holdout: float = 0.1  # last fraction of the trajectories, never trained on

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        if min(self.epochs, self.batch, *self.hidden) < 1 or self.history < 0:
            raise ValueError(
                "epochs, batch and every hidden width must be at least 1 and history not negative."
            )
        if self.learning_rate <= 0 or self.weight_decay < 0 or not 0 < self.holdout < 1:
            raise ValueError(
                "learning_rate must be positive, weight_decay not negative and holdout lie in "
                "(0, 1)."
            )
        if self.schedule not in SCHEDULES:
            raise ValueError(
                f"schedule must be one of {', '.join(SCHEDULES)}, got {self.schedule!r}."
            )


@dataclass(frozen=True)
class ActionVAE:
    """A fitted autoencoder.

    Attributes:
        network: A stack of one lane.
        frames: Scaling of the frames it reads, ``[F]``.
        history: Frames read, newest first.
        hidden: Layer widths of encoder and decoder.
    """

    network: ConditionalVAE
    frames: Normaliser
    history: int
    hidden: tuple[int, ...]

    def save(self, folder: Path) -> None:
        """Write one safetensors file into an existing folder."""
        header = {
            "format": FORMAT,
            "history": self.history,
            "actions": self.network.latent // 2,
            "hidden": list(self.hidden),
        }
        scaling = {"frames.mean": self.frames.mean, "frames.scale": self.frames.scale}
        save_tensors(folder / FILE, self.network.state_dict() | scaling, header)

    @classmethod
    def load(cls, folder: Path) -> "ActionVAE":
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: If the file holds something else.
        """
        tensors, header = load_tensors(folder / FILE)
        if header.get("format") != FORMAT:
            raise ValueError(
                f"{folder / FILE} holds {header.get('format')!r}, expected {FORMAT!r}."
            )
        frames = Normaliser(tensors.pop("frames.mean"), tensors.pop("frames.scale"))
        history, hidden = header["history"], tuple(header["hidden"])
        network = ConditionalVAE([0], history * len(frames.mean), header["actions"], hidden)
        network.load_state_dict(tensors)
        return cls(network.requires_grad_(False), frames, history, hidden)


class ActionReconstruction:
    """Autoencoders of L lanes, applied to the observations of policies.

    Args:
        models: One per lane, of equal shapes.
        scaling: Scaling of the frames that policies see, ``[L, F]``.
        device: Where to compute.
    """

    def __init__(
        self, models: Sequence[ActionVAE], scaling: Normaliser, device: torch.device
    ) -> None:
        first = models[0]
        self.latent = first.network.latent
        self._seen = first.history * len(first.frames.mean)
        self._network = ConditionalVAE(
            [0] * len(models), self._seen, self.latent // 2, first.hidden
        )
        states = [model.network.state_dict() for model in models]
        self._network.load_state_dict({n: torch.cat([s[n] for s in states]) for n in states[0]})
        # Gradients flow into observations and actions, not into the weights.
        self._network.requires_grad_(False).to(device)
        own, given = Normaliser.stack([m.frames for m in models]).to(device), scaling.to(device)
        for part in (self._network.encoder, self._network.decoder):
            weight, bias = part.affine()[0]
            folded = read_in_scaling(weight, bias, own, given, first.history)
            for old, new in zip((weight, bias), folded, strict=True):
                old.copy_(new)

    def __call__(self, observations: Tensor, actions: Tensor, noise: Tensor) -> Tensor:
        """Reconstruct actions; differentiable in observations and actions.

        Args:
            observations: ``[L, N, O]`` frames, newest first, in the policies' scaling.
            actions: ``[L, N, A]``.
            noise: Standard normal ``[L, N, latent]``.

        Returns:
            ``[L, N, A]`` decoded from one sample of the latents.
        """
        return self._network.reconstruct(observations[..., : self._seen], actions, noise)[0]


def fit_action_vae(
    dataset: OfflineDataset,
    config: ActionVAEConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[ActionVAE]:
    """Train an autoencoder of a dataset's actions.

    Args:
        dataset: The log.
        config: Architecture and schedule.
        key: Random stream, see :func:`components.core.random_streams.lane_key`.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out losses.

    Returns:
        The autoencoder; its held-out loss, reconstruction error and divergence.

    Raises:
        ValueError: If ``config.history`` is more than the frames of an observation.
        DivergedError: A network never had a finite state of finite held-out loss.
    """
    split = split_episodes(dataset, config.holdout)
    trained_on = split.trained_transitions(dataset)
    scaling = split.scaling(dataset)
    data = LaneData([dataset.with_history(config.history)], device, scaling=lambda _: scaling)
    network = ConditionalVAE([key], data.observation_width, data.action_width, config.hidden).to(
        device
    )
    held_out = torch.arange(trained_on, dataset.transitions, device=device)[None]
    latents = lane_generator(lane_key(key, "validation")).standard_normal(
        (1, held_out.shape[1], network.latent), "f4"
    )
    fixed = torch.from_numpy(latents).to(device)

    def losses(net: ConditionalVAE, row: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return net.losses(data.observations(row), data.actions(row), noise)

    def training_loss(
        net: ConditionalVAE, drawn: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        loss, error, divergence = losses(net, drawn["row"], drawn["noise"])
        return loss, {
            "model/reconstruction_error": error.detach(),
            "model/divergence": divergence.detach(),
        }

    @torch.no_grad()
    def validate(net: ConditionalVAE) -> Tensor:
        """Held-out loss, reconstruction error and divergence ``[3, 1]``, over all rows."""
        total = torch.zeros(3, 1, device=device)
        parts = (tensor.split(VALIDATED_AT_ONCE, dim=1) for tensor in (held_out, fixed))
        for row, noise in zip(*parts, strict=True):
            total += row.shape[1] * torch.stack(losses(net, row, noise))
        return total / held_out.shape[1]

    streams = LaneStreams(
        [key],
        {
            "row": Integers([trained_on], config.batch),
            "noise": Normal(config.batch, network.latent),
        },
        device,
    )
    fit = StackedFit(
        network,
        1,
        training_loss,
        streams,
        learning_rate=config.learning_rate,
        schedule=config.schedule,
        weight_decay=config.weight_decay,
    )
    per_epoch = max(1, trained_on // config.batch)
    curves = fit.run(
        lambda net: validate(net)[0],
        [dataset.card.name],
        updates=config.epochs * per_epoch,
        validate_every=per_epoch,
        checkpoint=checkpoint,
        monitor=monitor,
    )
    ended = ended_at(curves, fit.best_loss)
    loss, error, divergence = validate(fit.best).flatten().tolist()
    model = ActionVAE(fit.best.cpu().requires_grad_(False), scaling, data.history, config.hidden)
    metrics = {"validation_reconstruction_error": error, "validation_divergence": divergence}
    metrics |= nothing_learned(fit.best_loss, fit.untrained_loss)
    return Fit(model, loss, metrics, curves.of_lane(0), ended)
