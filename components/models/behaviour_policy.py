"""The learned behaviour policy: a deterministic clone of whatever generated the log (thesis 6.1).

``beta(s) = tanh(MLP(s))`` minimises the mean squared error to the logged actions. It tells the
other learners what the operators of the machine would have done, and how far a new policy moves
away. The last trajectories are held out; the state with the lowest held-out loss is kept.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from components.data.dataset import OfflineDataset
from components.data.lanes import LaneData
from components.data.splits import split_episodes
from components.models.supervised import UNWATCHED, Fit, Monitor
from components.networks import LaneStreams, StackedMLP, lanewise_mean, spawn_generators
from components.networks.checkpoint import (
    load_optimizer_state,
    module_state,
    optimizer_state,
    prefixed,
    with_prefix,
)
from components.networks.policy import Policy, PolicyCard
from components.networks.training import Curves, TrainingLoop, adam

__all__ = ["BehaviourPolicyConfig", "fit_behaviour_policies", "fit_behaviour_policy"]


@dataclass(frozen=True, kw_only=True)
class BehaviourPolicyConfig:
    """How the clone is built and trained (thesis 6.6: one layer of 20, 50 epochs, Adam 3e-4)."""

    hidden: tuple[int, ...] = (20,)  # hidden layer widths
    epochs: int = 50  # passes over the training transitions
    batch: int = 512  # transitions per update
    learning_rate: float = 3e-4
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


class _BehaviourLearner:
    def __init__(
        self,
        data: LaneData,
        trained_on: Sequence[int],
        config: BehaviourPolicyConfig,
        keys: Sequence[int],
    ) -> None:
        self._data = data
        self.lanes = data.lanes
        sizes = (data.observation_width, *config.hidden, data.action_width)
        self.network = StackedMLP(spawn_generators(keys, "weights"), sizes).to(data.device)
        self.best = StackedMLP(spawn_generators(keys, "weights"), sizes).to(data.device)
        self.best_loss = torch.full((self.lanes,), math.inf, device=data.device)
        self._optimizer = adam(list(self.network.parameters()), config.learning_rate)
        self._streams = LaneStreams(
            keys,
            {
                "row": lambda g, lane, steps: g.integers(
                    trained_on[lane], size=(steps, config.batch)
                )
            },
            data.device,
        )

    def losses(self, network: StackedMLP, index: Tensor) -> Tensor:
        """Mean squared action error per lane on transitions ``index [L, B]``: ``[L]``."""
        actions = torch.tanh(network(self._data.observations(index)))
        return lanewise_mean((actions - self._data.actions(index)).square())

    def update(self, step: int) -> dict[str, Tensor]:
        loss = self.losses(self.network, self._streams.at(step)["row"])
        self._optimizer.zero_grad(set_to_none=True)
        loss.sum().backward()
        self._optimizer.step()
        return {"model/train_mse": loss.detach()}

    @torch.no_grad()
    def keep_best(self, losses: Tensor) -> None:
        better = losses < self.best_loss
        self.best_loss = torch.where(better, losses, self.best_loss)
        for kept, new in zip(self.best.parameters(), self.network.parameters(), strict=True):
            kept.copy_(torch.where(better[:, None, None], new, kept))

    def state_dict(self) -> dict[str, Tensor]:
        state = module_state({"network": self.network, "best": self.best})
        state["best_loss"] = self.best_loss
        return state | prefixed("optimizer", optimizer_state(self._optimizer))

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.network.load_state_dict(with_prefix("network", state))
        self.best.load_state_dict(with_prefix("best", state))
        self.best_loss.copy_(state["best_loss"])
        load_optimizer_state(self._optimizer, with_prefix("optimizer", state))


def fit_behaviour_policies(
    datasets: Sequence[OfflineDataset],
    config: BehaviourPolicyConfig,
    keys: Sequence[int],
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> tuple[list[Policy], list[dict[str, float]], Curves]:
    """Clone the behaviour behind each dataset, one lane per dataset.

    Args:
        datasets: Logs of equal shapes.
        config: Architecture and schedule.
        keys: One random stream per lane.
        device: Where to train.
        checkpoint: File to resume from and save to.
        monitor: Told the progress and the held-out losses.

    Returns:
        Per lane a policy and its held-out mean squared error; the learning curves.
    """
    data = LaneData(datasets, device)
    splits = [split_episodes(d, config.holdout) for d in datasets]
    trained_on = [
        int(d.episode_starts[s.train.stop]) for d, s in zip(datasets, splits, strict=True)
    ]
    held_out = [
        torch.arange(count, data.counts[lane], device=device)
        for lane, count in enumerate(trained_on)
    ]
    shortest = min(len(rows) for rows in held_out)
    validation_rows = torch.stack([rows[:shortest] for rows in held_out])
    learner = _BehaviourLearner(data, trained_on, config, keys)
    per_epoch = max(1, min(trained_on) // config.batch)
    updates = config.epochs * per_epoch

    def validate(done: int, curves: Curves) -> bool:
        if done % per_epoch == 0:
            with torch.no_grad():
                parts = [learner.losses(learner.network, r) for r in validation_rows.split(4096, 1)]
            sizes = torch.tensor([r.shape[1] for r in validation_rows.split(4096, 1)])
            losses = (torch.stack(parts) * sizes.to(device)[:, None]).sum(dim=0) / shortest
            curves.add(done, {"model/validation_mse": losses})
            learner.keep_best(losses)
            monitor.validated(done / updates, float(losses.mean()))
        return False

    members = [f"{d.card.name}#{lane}" for lane, d in enumerate(datasets)]
    loop = TrainingLoop(
        updates, members, checkpoint, log_every=per_epoch, progress=monitor.progress
    )
    curves = loop.run(learner, validate)
    policies = []
    for lane, dataset in enumerate(datasets):
        card = PolicyCard(
            algorithm="behaviour_policy",
            dataset=dataset.card.name,
            features=tuple(dataset.card.frame_features),
            history=data.history,
            actions=data.action_width,
            takes_lambda=False,
            steps=(updates,),
        )
        whole = Policy.of_networks(card, {"actor": learner.best.affine()}, data.frame_scaling)
        policies.append(whole.lane(lane, card))
    metrics = [{"validation_mse": float(loss)} for loss in learner.best_loss]
    return policies, metrics, curves


def fit_behaviour_policy(
    dataset: OfflineDataset,
    config: BehaviourPolicyConfig,
    key: int,
    device: torch.device,
    checkpoint: Path | None = None,
    monitor: Monitor = UNWATCHED,
) -> Fit[Policy]:
    """Clone the behaviour behind one dataset, see :func:`fit_behaviour_policies`."""
    [policy], [metrics], curves = fit_behaviour_policies(
        [dataset], config, [key], device, checkpoint, monitor
    )
    return Fit(policy, metrics["validation_mse"], metrics, curves.of_lane(0))
