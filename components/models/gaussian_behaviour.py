"""The behaviour policy as a distribution: a tanh-Gaussian fitted to the logged actions.

``a = tanh(u)``, ``u ~ N(mean(s), std(s)^2)`` maximises the likelihood of the logged actions. Its
mean is a deterministic policy; its spread before the tanh measures how exploratory the log is (EAS,
thesis chapter 4).

Actions are clipped before the inverse tanh, and the clip decides what the spread means: exploration
often acts at the bounds, and there the clip alone makes the inverse finite. The thesis does not say
where it clips; the order of its EAS needs a strong clip, and 0.9 is taken.

BRAC fits a behaviour of its own, see :mod:`components.algorithms.brac`, with an entropy bonus that
keeps it from collapsing on the actions of a deterministic controller. Here there is no bonus, as it
would raise the spread that is measured. The smooth bounds of the log deviation and the choice of
the state of highest held-out likelihood keep the spread finite.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.core.draws import Integers
from components.core.random_streams import LaneStreams
from components.core.tensors import load_tensors, save_tensors
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.splits import split_episodes
from components.models.supervised import (
    SCHEDULES,
    UNWATCHED,
    Fit,
    Monitor,
    StackedFit,
    ended_at,
    nothing_learned,
)
from components.networks import TanhGaussian
from components.networks.gaussian import LOG_STD_RANGE, log_density, raw_actions
from components.policies.policy import Policy, PolicyCard

__all__ = ["GaussianBehaviour", "GaussianBehaviourConfig", "fit_gaussian_behaviour"]

FORMAT = "gaussian-behaviour/1"
FILE = "spread.safetensors"
VALIDATION_CHUNK = 4096  # transitions at once, which limits the memory


@dataclass(frozen=True, kw_only=True)
class GaussianBehaviourConfig:
    """How the policy is built and trained."""

    hidden: tuple[int, ...] = (64, 64)  # hidden layer widths
    action_clip: float = 0.9  # logged actions are clipped to +- this before the inverse tanh
    epochs: int = 12  # passes over the training transitions
    batch: int = 256  # transitions per update
    learning_rate: float = 1e-3  # Adam, at the start
    schedule: str = "cosine"  # falling to zero over the epochs; or constant
    weight_decay: float = 0.0  # L2 term inside Adam
    holdout: float = 0.1  # last fraction of the trajectories, never trained on

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        if min(self.epochs, self.batch, *self.hidden) < 1:
            raise ValueError("epochs, batch and every hidden width must be at least 1.")
        if not 0 < self.action_clip < 1 or not 0 < self.holdout < 1:
            raise ValueError("action_clip and holdout must lie in (0, 1).")
        if self.learning_rate <= 0 or self.weight_decay < 0:
            raise ValueError("learning_rate must be positive and weight_decay not negative.")
        if self.schedule not in SCHEDULES:
            raise ValueError(f"schedule must be one of {', '.join(SCHEDULES)}.")


@dataclass(frozen=True)
class GaussianBehaviour:
    """P fitted Gaussian behaviour policies side by side.

    Attributes:
        mean: ``tanh`` of the mean, as deployable policies.
        spread: Weight ``[P, hidden, A]`` and bias ``[P, 1, A]`` of the layer that computes the log
            deviation, before its bounds, from the mean's last hidden layer.
    """

    mean: Policy
    spread: tuple[Tensor, Tensor]

    def network(self) -> TanhGaussian:
        """Networks of mean and spread, on observations scaled by ``mean.frames``."""
        *hidden, last = self.mean.layers
        whole = tuple(torch.cat(parts, dim=-1) for parts in zip(last, self.spread, strict=True))
        sizes = [len(hidden[0][0][0]), *(len(b[0, 0]) for _, b in hidden), len(last[1][0, 0])]
        network = TanhGaussian(
            [0] * self.mean.lanes, "stored", sizes, LOG_STD_RANGE, squash=True
        ).requires_grad_(False)
        for own, stored in zip(network.stack.affine(), [*hidden, whole], strict=True):
            for parameter, tensor in zip(own, stored, strict=True):
                parameter.copy_(tensor)
        return network.to(last[0].device)

    @torch.no_grad()
    def distribution(self, histories: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation before the tanh, ``[P, B, A]`` each.

        Args:
            histories: ``[P, B, H, F]`` raw frames, newest first.
        """
        frames = self.mean.frames
        scaled = (histories - frames.mean[:, None, None]) / frames.scale[:, None, None]
        mean, log_std = self.network()(scaled.flatten(start_dim=2))
        return mean, log_std.exp()

    def save(self, folder: Path) -> None:
        """Write the policy's files, and the spread beside them, into an existing folder."""
        weight, bias = self.spread
        save_tensors(folder / FILE, {"weight": weight, "bias": bias}, {"format": FORMAT})
        self.mean.save(folder)

    @classmethod
    def load(cls, folder: Path) -> "GaussianBehaviour":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If the folder holds no policy or no spread.
            ValueError: If a file holds something else.
        """
        mean = Policy.load(folder)
        tensors, header = load_tensors(folder / FILE)
        if header.get("format") != FORMAT:
            raise ValueError(
                f"{folder / FILE} holds {header.get('format')!r}, expected {FORMAT!r}."
            )
        return cls(mean, (tensors["weight"], tensors["bias"]))


def fit_gaussian_behaviour(
    dataset: OfflineDataset,
    config: GaussianBehaviourConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[GaussianBehaviour]:
    """Fit a Gaussian behaviour policy to a dataset.

    Args:
        dataset: The log.
        config: Architecture and schedule.
        key: Random stream, see :func:`components.core.random_streams.lane_key`.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out losses.

    Returns:
        The policy in its best held-out state; the mean negative log density of the held-out
        actions, clipped as in training; among the metrics the mean standard deviation in their
        states.

    Raises:
        DivergedError: A network never had a finite state of finite held-out loss.
    """
    split = split_episodes(dataset, config.holdout)
    trained = split.trained_transitions(dataset)
    data = LaneData([dataset], device, scaling=split.scaling)
    held_out = torch.arange(trained, dataset.transitions, device=device)[None]
    sizes = (data.observation_width, *config.hidden, data.action_width)
    network = TanhGaussian([key], "weights", sizes, LOG_STD_RANGE, squash=True).to(device)

    def cost(network: TanhGaussian, index: Tensor) -> Tensor:
        """Negative log densities ``[1, B]`` of logged actions."""
        mean, log_std = network(data.observations(index))
        return -log_density(
            mean, log_std, raw_actions(data.actions(index), 1.0 - config.action_clip)
        )

    def loss(
        network: TanhGaussian, drawn: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        return cost(network, drawn["row"]).mean(dim=1), {}

    def validate(network: TanhGaussian) -> Tensor:
        parts = [cost(network, rows) for rows in held_out.split(VALIDATION_CHUNK, dim=1)]
        return torch.cat(parts, dim=1).mean(dim=1)

    rows = {"row": Integers([trained], config.batch)}
    fitting = StackedFit(
        network,
        1,
        loss,
        LaneStreams([key], rows, device),
        learning_rate=config.learning_rate,
        schedule=config.schedule,
        weight_decay=config.weight_decay,
    )
    per_epoch = max(1, trained // config.batch)
    curves = fitting.run(
        validate,
        [dataset.card.name],
        updates=config.epochs * per_epoch,
        validate_every=per_epoch,
        checkpoint=checkpoint,
        monitor=monitor,
    )
    ended = ended_at(curves, fitting.best_loss)
    card = PolicyCard(
        algorithm="gaussian_behaviour",
        dataset=dataset.card.name,
        features=tuple(dataset.card.frame_features),
        history=data.history,
        actions=data.action_width,
        takes_proximity=False,
        steps=(config.epochs * per_epoch,),
    )
    policy = Policy.of_networks(card, {"actor": fitting.best.mean_network()}, data.frame_scaling)
    last = fitting.best.stack.affine()[-1]
    weight, bias = (part.detach()[..., data.action_width :].cpu().clone() for part in last)
    with torch.no_grad():
        parts = [
            fitting.best(data.observations(rows))[1].exp()
            for rows in held_out.split(VALIDATION_CHUNK, dim=1)
        ]
    metrics = {
        "validation_nll": float(fitting.best_loss),
        "validation_spread": float(torch.cat(parts, dim=1).mean()),
    } | nothing_learned(fitting.best_loss, fitting.untrained_loss)
    behaviour = GaussianBehaviour(policy, (weight, bias))
    return Fit(behaviour, metrics["validation_nll"], metrics, curves.of_lane(0), ended)
