"""Log a controller on many copies of the Industrial Benchmark at once.

The logged frames are those that the controller observed, each stored once; an observation (the last
30 of them) is gathered when it is needed (`history.py`). Actions are rounded to float32 *before*
the machine receives them, so the stored action is the one that was executed.

Shapes: E trajectories of T steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from components.data.controllers.industrial import Controller, epsilon_greedy
from components.environments.frame_history import HISTORY_LENGTH, FrameHistory
from components.environments.industrial.benchmark import IndustrialBenchmark

__all__ = ["Log", "collect"]


@dataclass(frozen=True)
class Log:
    """What was recorded.

    Attributes:
        frames: `[E, T + 1, 6]`; frame 0 is the one after the reset, frame t + 1 follows action t.
        actions: `[E, T, 3]` in [-1, 1].
        rewards: `[E, T]` of the state after the action, divided by 100.
    """

    frames: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]


def collect(
    controller: Controller,
    *,
    epsilon: float,
    setpoint: float,
    trajectories: int,
    steps: int,
    noise: np.random.Generator,
    exploration: np.random.Generator,
) -> Log:
    """Log trajectories of a controller with whole-vector epsilon-greedy exploration.

    Args:
        controller: maps histories `[E, 30, 6]` to actions `[E, 3]`.
        epsilon: probability per step that the whole action vector is random.
        setpoint: of the machine, constant throughout.
        trajectories: E, all of them run at once.
        steps: T; the machine never terminates, so every trajectory is cut by time.
        noise: generator of the machine's noise.
        exploration: generator of epsilon-greedy.
    """
    environment = IndustrialBenchmark(trajectories, setpoint)
    frames = np.empty((trajectories, steps + 1, 6), dtype=np.float32)
    actions = np.empty((trajectories, steps, 3), dtype=np.float32)
    rewards = np.empty((trajectories, steps), dtype=np.float32)
    newest = environment.reset(noise)
    history = FrameHistory(newest, HISTORY_LENGTH)
    frames[:, 0] = newest
    for step in range(steps):
        wanted = epsilon_greedy(controller(history.window), epsilon, exploration)
        actions[:, step] = wanted
        newest, reward = environment.step(actions[:, step])
        history.push(newest)
        frames[:, step + 1] = newest
        rewards[:, step] = reward
    return Log(frames, actions, rewards)
