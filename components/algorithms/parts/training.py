"""Train a stack of policies: the budget cut into snapshots, resumable at any moment.

Training emits snapshots, policies at equally spaced points of the budget, and never evaluates them.
A lane ends where its loss becomes infinite or undefined, or a weight of its policy, or an action of
it in states of the log: the other lanes go on, its remaining snapshots repeat its last finite one,
and the policy's card says when it ended. Whatever is stored is finite; a lane that ends before its
first snapshot leaves nothing. Diverging values that are still finite do not end a lane: such
policies are kept and evaluated like all others.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm
from components.algorithms.parts.learner import LearnerInputs, PolicyLearner
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.history import gather_history
from components.policies.policy import Policy, PolicyCard
from components.training.cuda_graphs import graphed
from components.training.divergence import DivergedError
from components.training.loop import Curves, TrainingLoop

__all__ = ["learner_inputs", "snapshot_steps", "train_policies"]

CPU = torch.device("cpu")
_LOOKED_AT: Final = 64  # states of the log in which every snapshot must act finitely


def snapshot_steps(updates: int, snapshots: int) -> tuple[int, ...]:
    """The updates after which a policy is kept: equally spaced, the last at the end.

    Raises:
        ValueError: If there are more snapshots than updates.
    """
    if snapshots < 1 or updates < snapshots:
        raise ValueError(
            f"{snapshots} snapshots need at least as many updates, got {updates}; raise updates."
        )
    return tuple(round(updates * (n + 1) / snapshots) for n in range(snapshots))


def learner_inputs(
    algorithm: Algorithm[Any],
    datasets: Sequence[OfflineDataset],
    seeds: Sequence[int],
    models: Mapping[str, Sequence[Any]],
    device: torch.device,
) -> LearnerInputs:
    """What a stack of learners is made of; lanes have the streams of (dataset, algorithm, seed).

    Args:
        algorithm: Its record.
        datasets: One per lane.
        seeds: One per lane.
        models: Fitted models by name, one per lane each; those that the algorithm needs.
        device: Where to learn.
    """
    return LearnerInputs(
        data=LaneData(datasets, device, algorithm.frame_epsilon),
        keys=[
            lane_key(data.card.name, algorithm.name, seed)
            for data, seed in zip(datasets, seeds, strict=True)
        ],
        models=dict(models),
    )


def train_policies(
    algorithm: Algorithm[Any],
    learner: PolicyLearner,
    datasets: Sequence[OfflineDataset],
    members: Sequence[str],
    *,
    updates: int,
    snapshots: int,
    work: Path,
    progress: Callable[[float], None],
    save_every: float = 20.0,
    device: torch.device = CPU,
) -> tuple[list[Policy | DivergedError], Curves]:
    """Train all lanes and collect their snapshots.

    Args:
        algorithm: Its name is on the policies' cards.
        learner: A new stack of L learners.
        datasets: One per lane.
        members: Names of the lanes, stable across restarts.
        updates: Budget.
        snapshots: S, equally spaced.
        work: Folder that survives a kill; holds the checkpoint and the snapshots so far.
        progress: Called with the finished fraction of the budget, 0 to 1. It is 0 throughout
            pretraining, whose updates may take a hundredth of the time of others.
        save_every: Seconds between checkpoints.
        device: The learner's.

    Returns:
        Per lane a policy stack of S snapshots, or why there is none; the learning curves.

    Raises:
        DivergedError: If a policy is not finite before its first update.
    """
    before = learner.pretraining
    everything = before + updates
    steps = tuple(before + step for step in snapshot_steps(updates, snapshots))
    folders = {step: work / f"snapshot-{step:08d}" for step in (0, *steps)}
    cards = [
        PolicyCard(
            algorithm=algorithm.name,
            dataset=data.card.name,
            features=tuple(data.card.frame_features),
            history=data.card.history,
            actions=len(data.card.action_features),
            takes_proximity=algorithm.takes_proximity,
            steps=(0,),
        )
        for data in datasets
    ]

    seen = [_logged_histories(data) for data in datasets]

    def keep_snapshot(done: int, curves: Curves) -> bool:
        stack = learner.policy(cards[0])
        for lane, (member, card) in enumerate(zip(members, cards, strict=True)):
            own = replace(stack.card, dataset=card.dataset, steps=(done,))
            policy = stack.lane(lane, own)
            if not _sound(policy, seen[lane]):
                policy = stand_in(done, member, own)
            folder = folders[done] / member
            folder.mkdir(parents=True, exist_ok=True)
            policy.save(folder)
        return False

    def stand_in(done: int, member: str, card: PolicyCard) -> Policy:
        """The snapshot before, as that of a lane that has ended."""
        if done == 0:
            raise DivergedError(
                f"before its first update the policy of {card.algorithm} on {card.dataset} was "
                "not finite"
            )
        former = Policy.load(folders[max(step for step in folders if step < done)] / member)
        ended_at = done if former.card.ended_at is None else former.card.ended_at
        return replace(former, card=replace(former.card, steps=(done,), ended_at=ended_at))

    log_every = max(1, min(100, updates // 100))
    loop = TrainingLoop(
        everything,
        members,
        work / "checkpoint.safetensors",
        log_every,
        save_every,
        lambda fraction: progress(max(0.0, (fraction * everything - before) / updates)),
    )
    if not loop.checkpoint_exists:
        keep_snapshot(0, Curves())
    curves = loop.run(graphed(learner, device), keep_snapshot, folders)
    policies = [
        _one_stack(
            [Policy.load(folders[step] / member) for step in (0, *steps)], curves.ended_at(lane)
        )
        for lane, member in enumerate(members)
    ]
    return policies, curves


def _logged_histories(dataset: OfflineDataset) -> Tensor:
    """Observations ``[1, B, H, F]`` of transitions all over a log, the first and last included."""
    some = np.unique(np.linspace(0, dataset.transitions - 1, _LOOKED_AT).round().astype(np.int64))
    history = dataset.card.history
    rows, first = dataset.frame_rows()[some], dataset.first_rows()[some]
    found = torch.from_numpy(np.array(gather_history(dataset.frames, rows, first, history)))
    return found.view(1, len(some), history, -1)


def _sound(policy: Policy, seen: Tensor) -> bool:
    """Whether all numbers of a policy are finite, and its actions at histories ``[1, B, H, F]``."""
    if not bool(policy.finite.all()):
        return False
    shape, card = seen.shape[:2], policy.card
    proximity = torch.linspace(0.0, 1.0, shape[1])[None] if card.takes_proximity else None
    noise = torch.zeros(*shape, card.candidates, card.noise) if card.candidates else None
    return bool(policy.act(seen, proximity, noise).isfinite().all())


def _one_stack(snapshots: Sequence[Policy], ended_at: int | None) -> Policy | DivergedError:
    """Snapshots after the first as one policy stack, or why there is none.

    A lane whose loss has become infinite or undefined has ended, whatever its later numbers are;
    snapshots after that repeat the one before. Where it ended before the first snapshot, there is
    nothing to repeat: the untrained policy, given first, is no result of training.
    """
    ends = [ended_at, *(snapshot.card.ended_at for snapshot in snapshots)]
    ended_at = min((end for end in ends if end is not None), default=None)
    kept = [snapshots[0]]
    for snapshot in snapshots[1:]:
        ended = ended_at is not None and snapshot.card.steps[0] >= ended_at
        kept.append(kept[-1] if ended else snapshot)
    if kept[1] is snapshots[0]:
        return DivergedError(
            f"its loss or its policy was no longer finite at update {ended_at}, before the first "
            f"snapshot at update {snapshots[1].card.steps[0]}"
        )
    steps = tuple(snapshot.card.steps[0] for snapshot in snapshots[1:])
    return Policy.concatenate(replace(kept[1].card, steps=steps, ended_at=ended_at), kept[1:])
