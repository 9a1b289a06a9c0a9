"""Train a stack of policies: the budget cut into snapshots, resumable at any moment.

Training emits snapshots, policies at equally spaced points of the budget, and never evaluates them.
A lane whose loss becomes infinite or undefined ends there: the other lanes go on, its remaining
snapshots repeat its last finite policy, and the policy's card says when it ended. Diverging values
that are still finite do not end a lane: such policies are kept and evaluated like all others.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from components.algorithms.parts.algorithm import Algorithm
from components.algorithms.parts.learner import PolicyLearner
from components.data.dataset import OfflineDataset
from components.policies.policy import Policy, PolicyCard
from components.training.cuda_graphs import graphed
from components.training.loop import Curves, TrainingLoop

__all__ = ["snapshot_steps", "train_policies"]

CPU = torch.device("cpu")


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
) -> tuple[list[Policy], Curves]:
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
        Per lane a policy stack of S snapshots; the learning curves.
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

    def keep_snapshot(done: int, curves: Curves) -> bool:
        if done in folders:
            policy = learner.policy(cards[0])
            for lane, (member, card) in enumerate(zip(members, cards, strict=True)):
                folder = folders[done] / member
                folder.mkdir(parents=True, exist_ok=True)
                own = replace(policy.card, dataset=card.dataset, steps=(done,))
                policy.lane(lane, own).save(folder)
        return False

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
    curves = loop.run(graphed(learner, device), keep_snapshot)
    policies = [
        _one_stack(
            [Policy.load(folders[step] / member) for step in (0, *steps)], curves.ended_at(lane)
        )
        for lane, member in enumerate(members)
    ]
    return policies, curves


def _one_stack(snapshots: Sequence[Policy], ended_at: int | None) -> Policy:
    """Snapshots after the first as one policy stack; broken ones repeat the last finite one.

    A lane whose loss has become infinite or undefined has ended, whatever its later numbers are;
    where it ended before the first snapshot, the untrained policy, given first, is taken.
    """
    kept = [snapshots[0]]
    for snapshot in snapshots[1:]:
        ended = ended_at is not None and snapshot.card.steps[0] >= ended_at
        broken = ended or not bool(snapshot.finite)
        if broken and ended_at is None:
            ended_at = snapshot.card.steps[0]
        kept.append(kept[-1] if broken else snapshot)
    steps = tuple(snapshot.card.steps[0] for snapshot in snapshots[1:])
    return Policy.concatenate(replace(kept[0].card, steps=steps, ended_at=ended_at), kept[1:])
