"""Train a stack of policies: the budget cut into snapshots, resumable at any moment.

Training emits snapshots, policies at equally spaced points of the budget, and never evaluates them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from components.algorithms.base import PolicyLearner
from components.data.dataset import OfflineDataset
from components.networks.policy import Policy, PolicyCard
from components.networks.training import Curves, TrainingLoop

__all__ = ["snapshot_steps", "train_policies"]


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
    algorithm: str,
    learner: PolicyLearner,
    datasets: Sequence[OfflineDataset],
    members: Sequence[str],
    *,
    updates: int,
    snapshots: int,
    takes_lambda: bool,
    work: Path,
    progress: Callable[[float], None],
    save_every: float = 20.0,
) -> tuple[list[Policy], Curves]:
    """Train all lanes and collect their snapshots.

    Args:
        algorithm: Name for the policies' cards.
        learner: A stack of L fresh learners.
        datasets: One per lane.
        members: Names of the lanes, stable across restarts.
        updates: Budget.
        snapshots: S, equally spaced.
        takes_lambda: For the policies' cards.
        work: Folder that survives a kill; holds the checkpoint and the snapshots so far.
        progress: Told the finished fraction.
        save_every: Seconds between checkpoints.

    Returns:
        Per lane a policy stack of S snapshots; the learning curves.
    """
    steps = snapshot_steps(updates, snapshots)
    folders = {step: work / f"snapshot-{step:08d}" for step in steps}

    def cards(of: Sequence[int]) -> list[PolicyCard]:
        return [
            PolicyCard(
                algorithm=algorithm,
                dataset=data.card.name,
                features=tuple(data.card.frame_features),
                history=data.card.history,
                actions=len(data.card.action_features),
                takes_lambda=takes_lambda,
                steps=tuple(of),
            )
            for data in datasets
        ]

    def keep_snapshot(done: int, curves: Curves) -> bool:
        if done in folders:
            policy = learner.policy(cards([done])[0])
            for lane, member in enumerate(members):
                folder = folders[done] / member
                folder.mkdir(parents=True, exist_ok=True)
                policy.lane(lane, cards([done])[lane]).save(folder)
        return False

    log_every = max(1, min(100, updates // 100))
    loop = TrainingLoop(
        updates, members, work / "checkpoint.safetensors", log_every, save_every, progress
    )
    curves = loop.run(learner, keep_snapshot)
    policies = [
        Policy.concatenate(card, [Policy.load(folders[step] / member) for step in steps])
        for card, member in zip(cards(steps), members, strict=True)
    ]
    return policies, curves
