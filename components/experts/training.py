"""Train experts of one robot, one lane per seed, and keep the best policy of every seed.

Every few thousand steps the current policies run whole episodes without noise, and the policy with
the highest mean return so far is kept. This choice uses the real system: an expert is part of data
generation. The kept return is biased upwards, since it is the greatest of many; the choice among
seeds therefore evaluates the chosen policy in new episodes.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator, lane_key
from components.environments.mujoco.robots import Robots
from components.experts.config import ExpertConfig
from components.experts.episodes import episode_rewards
from components.experts.online import OnlineLearner
from components.experts.replay import Replay
from components.networks import StackedMLP
from components.policies.policy import Policy, PolicyCard
from components.training.divergence import DivergedError
from components.training.loop import Curves, TrainingLoop

__all__ = ["train_experts", "without_denormals"]

MakeRobots = Callable[[int], Robots]
"""Makes the given number of copies of the robot."""


def train_experts(
    name: str,
    config: ExpertConfig,
    keys: Sequence[int],
    members: Sequence[str],
    make_robots: MakeRobots,
    *,
    work: Path,
    device: torch.device,
    progress: Callable[[float], None] = lambda fraction: None,
    save_every: float = 60.0,
) -> tuple[list[Policy | DivergedError], list[float], Curves]:
    """Train all lanes.

    Args:
        name: Of the robot, for the policies' cards.
        config: Settings.
        keys: One random stream per lane.
        members: Names of the lanes, stable across restarts.
        make_robots: Makes copies of the robot.
        work: Folder that survives a kill; holds the checkpoint and all transitions.
        device: Where to learn.
        progress: Called with the finished fraction, 0 to 1.
        save_every: Seconds between checkpoints.

    Returns:
        Per lane its best policy, whose card says at which step it was found, or why there is none;
        the mean return it had then; the learning curves.
    """
    robots = make_robots(len(keys))
    evaluated = make_robots(len(keys) * config.episodes)
    widths = len(robots.frame_features), len(robots.action_features)
    files = [work / f"{member}.transitions" for member in members]
    replay = Replay(len(keys), config.steps, *widths, device, files)
    learner = OnlineLearner(config, keys, robots, replay, device)

    def evaluate(done: int, curves: Curves) -> bool:
        starts = [
            lane_generator(lane_key(key, "evaluation", done), episode)
            for key in keys
            for episode in range(config.episodes)
        ]
        undefined = torch.zeros(len(keys), dtype=torch.bool)
        act = _deterministic(learner.actor, device, undefined)
        rewards = episode_rewards(act, evaluated, starts, config.horizon)
        returns = torch.from_numpy(rewards.sum(axis=1)).view(len(keys), -1).mean(dim=1)
        returns[undefined] = torch.nan
        learner.keep_best(done, returns)
        curves.add(done, {"evaluation/return": returns})
        return False

    loop = TrainingLoop(
        config.steps,
        members,
        work / "checkpoint.safetensors",
        max(1, min(1000, config.steps // 100)),
        save_every,
        progress,
    )
    with without_denormals():
        evaluated_at = range(config.evaluate_every, config.steps + 1, config.evaluate_every)
        curves = loop.run(learner, evaluate, evaluated_at)
    card = PolicyCard(
        algorithm=config.method,
        dataset=f"none, trained on {name} itself",
        features=tuple(robots.frame_features),
        history=1,
        actions=widths[1],
        takes_proximity=False,
        steps=tuple(learner.best_step),
    )
    identity = Normaliser(torch.zeros(len(keys), widths[0]), torch.ones(len(keys), widths[0]))
    stack = Policy.of_networks(card, {"actor": learner.best.affine()}, identity)
    policies: list[Policy | DivergedError] = []
    for lane, step in enumerate(learner.best_step):
        ended_at = curves.ended_at(lane)
        finite, _ = curves.of_lane(lane).get("evaluation/return", ((), ()))
        if ended_at is not None and max(finite, default=0) <= config.random_steps:
            error = f"its loss or its policy was no longer finite at step {ended_at}, and no "
            policies.append(DivergedError(f"{error}policy that had learned was evaluated before"))
        else:
            policies.append(stack.lane(lane, replace(card, steps=(step,), ended_at=ended_at)))
    return policies, learner.best_return, curves


@contextmanager
def without_denormals() -> Iterator[None]:
    """Flush denormal numbers to 0 within the block.

    Adam's moments of a unit that is never active shrink by a tenth in every update. After a
    thousand updates they are denormal, and arithmetic with such numbers takes ten times as long on
    many processors.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def _deterministic(
    actor: StackedMLP, device: torch.device, undefined: torch.Tensor
) -> Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]:
    """A function from frames to actions: L networks act for N / L consecutive copies each.

    Lanes that act undefined are marked in ``undefined [L]`` and stand still, so that the others can
    be evaluated.
    """

    @torch.no_grad()
    def act(frames: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        seen = torch.from_numpy(frames).float().to(device)
        actions = torch.tanh(actor(seen.view(actor.lanes, -1, frames.shape[1])))
        undefined.logical_or_(actions.isnan().flatten(1).any(dim=1).cpu())
        chosen: npt.NDArray[np.float64] = actions.nan_to_num_().flatten(0, 1).double().cpu().numpy()
        return chosen

    return act
