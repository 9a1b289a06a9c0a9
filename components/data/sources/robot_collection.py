"""Log a noisy expert on copies of a robot; the log does not depend on the number of copies.

An episode is identified by its number: its start and its exploration, and therefore all of it,
follow from (key, number). A free copy takes the next number. The log is the episodes in the order
of their numbers, cut at the wanted number of steps, so long episodes are as likely to be in it as
short ones, whatever the order in which they finished.

Actions are rounded to float32 *before* the robot receives them, so the stored action is the one
that was executed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from components.core.random_streams import lane_generator, lane_key

if TYPE_CHECKING:  # MuJoCo is slow to import
    from components.environments.mujoco.robots import Robots

__all__ = ["Episode", "Exploration", "collect_episodes", "episode_arrays"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exploration:
    """Exploration added to the expert's actions.

    Attributes:
        epsilon: probability per step that the whole action is uniform on [-1, 1].
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
        terminated: whether it ended in a fall; otherwise it ended by time-out.
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


class _Collector:
    """N copies, each of which runs the episode of some number, or is free."""

    def __init__(self, robots: "Robots", exploration: Exploration, horizon: int, key: int) -> None:
        self._robots, self._exploration = robots, exploration
        self._horizon, self._key = horizon, key
        copies, width = robots.copies, len(robots.action_features)
        shape = (copies, horizon, width)
        self._frames = np.empty((copies, horizon + 1, len(robots.frame_features)), dtype=np.float32)
        self._actions = np.empty(shape, dtype=np.float32)
        self._rewards = np.empty((copies, horizon), dtype=np.float32)
        self._uniform, self._noise = np.zeros(shape), np.zeros(shape)
        self._copies = np.arange(copies)
        self._number = np.full(copies, -1)  # of the episode; -1 for none
        self._elapsed = np.zeros(copies, dtype=np.int64)
        self._starts = [lane_generator(key)] * copies  # of each copy's episode
        self._current = robots.reset(self._starts)  # replaced by the episodes' own starts
        self._begun = 0
        self.steps = 0  # of all begun episodes so far

    @property
    def busy(self) -> bool:
        """Whether any copy runs an episode."""
        return bool((self._number >= 0).any())

    def fill(self) -> None:
        """Begin the next episodes on all free copies."""
        free = self._copies[self._number < 0]
        if not len(free):
            return
        for copy in free:
            number, self._begun = self._begun, self._begun + 1
            self._number[copy] = number
            self._starts[copy] = lane_generator(lane_key(self._key, "start"), number)
            rng = lane_generator(lane_key(self._key, "exploration"), number)
            planned = self._exploration.plan(rng, self._horizon, self._actions.shape[2])
            self._uniform[copy], self._noise[copy] = planned
        self._elapsed[free] = 0
        mask = np.isin(self._copies, free)
        self._current[free] = self._robots.reset_copies(mask, self._starts)
        self._frames[free, 0] = self._current[free]

    def step(self, expert: Callable[[Array], Array]) -> dict[int, Episode]:
        """Let every copy act once; returns the episodes that end, by number."""
        active = self._copies[self._number >= 0]
        at = self._elapsed[active]
        taken = np.zeros_like(self._actions[:, 0])
        uniform, noise = self._uniform[active, at], self._noise[active, at]
        noisy = np.clip(expert(self._current[active]) + noise, -1.0, 1.0)
        taken[active] = np.where(np.isnan(uniform), noisy, uniform)
        self._current, rewards = self._robots.step(taken.astype(np.float64))
        self._actions[active, at], self._rewards[active, at] = taken[active], rewards[active]
        self._frames[active, at + 1] = self._current[active]
        self._elapsed[active] += 1
        self.steps += len(active)
        fallen = self._robots.terminated
        ended = active[fallen[active] | (self._elapsed[active] == self._horizon)]
        finished = {int(self._number[copy]): self._episode(copy, fallen[copy]) for copy in ended}
        self._number[ended] = -1
        return finished

    def _episode(self, copy: int, fallen: np.bool_) -> Episode:
        t = self._elapsed[copy]
        return Episode(
            self._frames[copy, : t + 1].copy(),
            self._actions[copy, :t].copy(),
            self._rewards[copy, :t].copy(),
            bool(fallen),
        )


def collect_episodes(
    expert: Callable[[Array], Array],
    robots: "Robots",
    exploration: Exploration,
    *,
    horizon: int,
    transitions: int,
    key: int,
) -> list[Episode]:
    """Log episodes until there are enough steps; the last one is cut to fit.

    Args:
        expert: maps frames `[N, F]` to actions `[N, A]`.
        robots: copies of the robot.
        exploration: added to the expert's actions.
        horizon: time limit of an episode, in steps.
        transitions: steps in all.
        key: random stream.
    """
    collector = _Collector(robots, exploration, horizon, key)
    finished: dict[int, Episode] = {}
    collector.fill()
    while collector.busy:
        finished |= collector.step(expert)
        if collector.steps < transitions:  # episodes that have begun are run to their end
            collector.fill()
    log: list[Episode] = []
    missing = transitions
    while missing > 0:
        log.append(finished[len(log)].cut(missing))
        missing -= log[-1].steps
    return log


def episode_arrays(episodes: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    """The arrays of a dataset: episodes of different lengths one after the other."""
    lengths = [episode.steps for episode in episodes]
    last = np.cumsum(lengths) - 1
    terminated, truncated = (np.zeros(sum(lengths), dtype=np.bool_) for _ in range(2))
    terminated[last] = [episode.terminated for episode in episodes]
    truncated[last] = ~terminated[last]
    return {
        "frames": np.concatenate([episode.frames for episode in episodes]),
        "actions": np.concatenate([episode.actions for episode in episodes]),
        "rewards": np.concatenate([episode.rewards for episode in episodes]),
        "terminated": terminated,
        "truncated": truncated,
        "episode_starts": np.concatenate([[0], last + 1]).astype(np.int64),
    }
