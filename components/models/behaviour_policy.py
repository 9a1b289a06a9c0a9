"""The learned behaviour policy: a deterministic network that imitates the log (thesis 6.1).

``beta(s) = tanh(MLP(s))`` minimises the mean squared error to the logged actions. Other learners
measure by it how far a new policy moves away from the logged behaviour. The last trajectories are
held out; the state with the lowest held-out loss is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.core.draws import Integers
from components.core.random_streams import LaneStreams, spawn_generators
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
from components.networks import StackedMLP
from components.policies.policy import Policy, PolicyCard
from components.training.loop import Curves

__all__ = ["BehaviourPolicyConfig", "fit_behaviour_policies", "fit_behaviour_policy"]


@dataclass(frozen=True, kw_only=True)
class BehaviourPolicyConfig:
    """How the policy is built and trained (thesis 6.6: one layer of 20, 50 epochs, Adam 3e-4)."""

    hidden: tuple[int, ...] = (20,)  # hidden layer widths
    epochs: int = 50  # passes over the training transitions
    batch: int = 512  # transitions per update
    learning_rate: float = 3e-4  # Adam
    schedule: str = "constant"  # or cosine: falling to zero over the epochs
    weight_decay: float = 0.0  # L2 term inside Adam
    holdout: float = 0.1  # last fraction of the trajectories, never trained on

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the field and its range.
        """
        if self.epochs < 1 or self.batch < 1 or any(width < 1 for width in self.hidden):
            raise ValueError("epochs, batch and every hidden width must be at least 1.")
        if self.learning_rate <= 0 or not 0 < self.holdout < 1:
            raise ValueError("learning_rate must be positive and holdout lie in (0, 1).")
        if self.schedule not in SCHEDULES or self.weight_decay < 0:
            raise ValueError(
                f"schedule must be one of {', '.join(SCHEDULES)}; weight_decay is not negative."
            )


def fit_behaviour_policies(
    datasets: Sequence[OfflineDataset],
    config: BehaviourPolicyConfig,
    keys: Sequence[int],
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> tuple[list[Policy], list[dict[str, float]], Curves]:
    """Fit a behaviour policy to each dataset, one lane per dataset.

    Args:
        datasets: Logs of equal shapes.
        config: Architecture and schedule.
        keys: One random stream per lane.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Receives the progress and the held-out losses.

    Returns:
        Per lane a policy and its held-out mean squared error; the learning curves.

    Raises:
        DivergedError: A lane never had a finite state of finite held-out error.
    """
    data = LaneData(
        datasets, device, scaling=lambda d: split_episodes(d, config.holdout).scaling(d)
    )
    trained_on = [split_episodes(d, config.holdout).trained_transitions(d) for d in datasets]
    shortest = min(count - trained for count, trained in zip(data.counts, trained_on, strict=True))
    held_out = torch.tensor(trained_on, device=device)[:, None] + torch.arange(
        shortest, device=device
    )
    sizes = (data.observation_width, *config.hidden, data.action_width)
    fitting = StackedFit(
        StackedMLP(spawn_generators(keys, "weights"), sizes).to(device),
        data.lanes,
        lambda network, drawn: (_errors(network, data, drawn["row"]).mean(dim=1), {}),
        LaneStreams(keys, {"row": Integers(trained_on, config.batch)}, device),
        learning_rate=config.learning_rate,
        schedule=config.schedule,
        weight_decay=config.weight_decay,
    )

    def validate(network: StackedMLP) -> Tensor:
        parts = [_errors(network, data, rows).sum(dim=1) for rows in held_out.split(4096, dim=1)]
        return torch.stack(parts).sum(dim=0) / shortest

    per_epoch = max(1, min(trained_on) // config.batch)
    updates = config.epochs * per_epoch
    curves = fitting.run(
        validate,
        [f"{d.card.name}#{lane}" for lane, d in enumerate(datasets)],
        updates=updates,
        validate_every=per_epoch,
        checkpoint=checkpoint,
        monitor=monitor,
    )
    ended_at(curves, fitting.best_loss)
    policies = []
    for lane, dataset in enumerate(datasets):
        card = PolicyCard(
            algorithm="behaviour_policy",
            dataset=dataset.card.name,
            features=tuple(dataset.card.frame_features),
            history=data.history,
            actions=data.action_width,
            takes_proximity=False,
            steps=(updates,),
        )
        whole = Policy.of_networks(card, {"actor": fitting.best.affine()}, data.frame_scaling)
        policies.append(whole.lane(lane, card))
    metrics = [
        {"validation_mse": float(best)} | nothing_learned(best, untrained)
        for best, untrained in zip(fitting.best_loss, fitting.untrained_loss, strict=True)
    ]
    return policies, metrics, curves


def _errors(network: StackedMLP, data: LaneData, index: Tensor) -> Tensor:
    """Squared action errors ``[L, B]``, averaged over the action, of transitions ``[L, B]``."""
    actions = torch.tanh(network(data.observations(index)))
    return (actions - data.actions(index)).square().mean(dim=2)


def fit_behaviour_policy(
    dataset: OfflineDataset,
    config: BehaviourPolicyConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[Policy]:
    """Fit a behaviour policy to one dataset, see :func:`fit_behaviour_policies`."""
    [policy], [metrics], curves = fit_behaviour_policies(
        [dataset], config, [key], device, checkpoint, monitor
    )
    mse = metrics["validation_mse"]
    return Fit(policy, mse, metrics, curves.of_lane(0), curves.ended_at(0))
