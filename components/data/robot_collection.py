"""Log a noisy expert on copies of a robot, so that the log does not depend on the copies.

An episode is known by its number: its start, its exploration and therefore all of it follow from
(key, number). Copies take numbers in turn as they become free; the log is the episodes in the order
of their numbers, cut at the wanted number of steps. Long episodes are thus as likely to be in it as
short ones, whenever they were finished.

Actions are rounded to float32 *before* the robot receives them, so the stored action is the one
that was executed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from components.environments.robots import Robots
from components.networks.streams import lane_generator, lane_key

__all__ = ["Episode", "Exploration", "collect_episodes"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exploration:
    """How a log leaves the expert's path.

    Attributes:
        epsilon: chance per step that the whole action is uniform on [-1, 1].
        noise: deviation of the Gaussian noise on every entry of the other actions, which are then
            clipped to [-1, 1].
    """

    epsilon: float
    noise: float

    def plan(self, rng: np.random.Generator, steps: int, actions: int) -> tuple[Array, Array]:
        """Draw an episode's exploration.

        Returns:
            `[steps, A]` uniform actions, NaN where the expert acts; `[steps, A]` noise on these.
        """
        explores = rng.random(steps) < self.epsilon
        noise = rng.normal(0.0, self.noise, (steps, actions))
        uniform = rng.uniform(-1.0, 1.0, (steps, actions))
        return np.where(explores[:, None], uniform, np.nan), noise


@dataclass(frozen=True)
class Episode:
    """T steps of one episode.

    Attributes:
        frames: `[T + 1, F]`; the first is the start's.
        actions: `[T, A]`.
        rewards: `[T]` of the state after the action.
        terminated: whether it ended in a fall; otherwise its time was up.
    """

    frames: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: bool

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.rewards)

    def cut(self, steps: int) -> "Episode":
        """The first steps alone."""
        if steps >= self.steps:
            return self
        return Episode(
            self.frames[: steps + 1], self.actions[:steps], self.rewards[:steps], terminated=False
        )


def collect_episodes(
    expert: Callable[[Array], Array],
    machine: Robots,
    copies: int,
    exploration: Exploration,
    *,
    horizon: int,
    transitions: int,
    key: int,
) -> list[Episode]:
    """Log episodes until there are enough steps; the last one is cut to fit.

    Args:
        expert: maps frames `[N, F]` to actions `[N, A]`.
        machine: N copies of the robot.
        copies: N.
        exploration: how the log leaves the expert's path.
        horizon: steps after which an episode's time is up.
        transitions: steps in all.
        key: random stream.
    """
    features, width = len(machine.frame_features), len(machine.action_features)
    frames = np.empty((copies, horizon + 1, features), dtype=np.float32)
    actions = np.empty((copies, horizon, width), dtype=np.float32)
    rewards = np.empty((copies, horizon), dtype=np.float32)
    uniform, noise = (np.zeros((copies, horizon, width)) for _ in range(2))
    number = np.full(copies, -1)  # of the episode that a copy lives; -1 for none
    elapsed = np.zeros(copies, dtype=np.int64)
    starts = [lane_generator(key)] * copies  # of each copy's episode
    current = machine.reset(starts)  # undone by the first episodes' starts
    finished: dict[int, Episode] = {}
    begun = lived = 0
    slots = np.arange(copies)
    while True:
        # Every step of a begun episode counts for the log: once they suffice, none is begun.
        free = slots[number < 0] if lived < transitions else slots[:0]
        if len(free):
            number[free] = begun + np.arange(len(free))
            begun += len(free)
            elapsed[free] = 0
            for slot in free:
                starts[slot] = lane_generator(lane_key(key, "start"), int(number[slot]))
                rng = lane_generator(lane_key(key, "exploration"), int(number[slot]))
                uniform[slot], noise[slot] = exploration.plan(rng, horizon, width)
            current[free] = machine.reset_copies(np.isin(slots, free), starts)
            frames[free, 0] = current[free]
        living = slots[number >= 0]
        if not len(living):
            break
        now = elapsed.clip(max=horizon - 1)
        chosen = uniform[slots, now]
        noisy = np.clip(expert(current) + noise[slots, now], -1.0, 1.0)
        taken = np.where(np.isnan(chosen), noisy, chosen).astype(np.float32)
        following, reward = machine.step(taken.astype(np.float64))
        current = following
        at = elapsed[living]
        actions[living, at], rewards[living, at] = taken[living], reward[living]
        frames[living, at + 1] = current[living]
        elapsed[living] += 1
        lived += len(living)
        fallen = machine.terminated
        for slot in living[fallen[living] | (elapsed[living] == horizon)]:
            t = elapsed[slot]
            finished[number[slot]] = Episode(
                frames[slot, : t + 1].copy(),
                actions[slot, :t].copy(),
                rewards[slot, :t].copy(),
                bool(fallen[slot]),
            )
            number[slot] = -1
    log: list[Episode] = []
    missing = transitions
    for n in range(begun):
        if missing <= 0:
            break
        log.append(finished[n].cut(missing))
        missing -= log[-1].steps
    return log
