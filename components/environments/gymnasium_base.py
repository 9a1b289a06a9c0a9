"""Copies of a system behind Gymnasium's interfaces, single and vectorised.

An observation is the last frames, newest first, flattened frame by frame, float32. At the start of
an episode the first frame is repeated in the place of missing ones. These systems never terminate;
episodes end by time-out, if at all.
"""

from collections.abc import Mapping
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from components.environments.frame_history import FrameHistory

__all__ = ["EndlessSystem", "SingleEnv", "SystemVectorEnv", "observation_space"]

Observation = NDArray[np.float32]
Start = Mapping[str, ArrayLike] | None


class EndlessSystem(Protocol):
    """N copies of a system that never terminates, see :class:`.systems.BatchEnvironment`."""

    copies: int

    @property
    def action_features(self) -> tuple[str, ...]:
        """Names of the A values of an action, each in [-1, 1]."""

    def reset(self, rng: np.random.Generator, *, start: Start = None) -> NDArray[np.float64]:
        """Start all copies, with given start values; returns the first frames `[N, F]`."""

    def reset_copies(
        self, copies: NDArray[np.bool_], rng: np.random.Generator, *, start: Start = None
    ) -> NDArray[np.float64]:
        """Start the masked copies `[N]` again; returns their first frames."""

    def step(self, actions: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Act with `[N, A]`; returns frames `[N, F]` and rewards `[N]`."""


def observation_space(
    low: tuple[float, ...], high: tuple[float, ...], history: int
) -> spaces.Space[Any]:
    """The space of `history` frames within given bounds.

    Raises:
        ValueError: less than one frame.
    """
    if history < 1:
        raise ValueError(f"history is {history} frames; give at least 1.")
    lowest, highest = (np.tile(np.array(b, dtype=np.float32), history) for b in (low, high))
    return spaces.Box(lowest, highest, dtype=np.float32)


def _action_space(system: EndlessSystem) -> spaces.Space[Any]:
    return spaces.Box(-1.0, 1.0, (len(system.action_features),), dtype=np.float32)


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode is not None:
        raise ValueError(f"render mode {render_mode!r} does not exist; use None.")


def _check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    given = dict(options or {})
    for name in given:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r}; known are {', '.join(known)}.")
    return given


class SingleEnv(gym.Env[Observation, NDArray[np.floating]]):
    """One copy.

    Args:
        system: it alone.
        space: of the observations.
        history: frames in an observation.
        render_mode: these systems cannot be rendered; only None.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - declared so by Gymnasium

    def __init__(
        self,
        system: EndlessSystem,
        space: spaces.Space[Any],
        history: int,
        render_mode: str | None,
    ) -> None:
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self.observation_space = space
        self.action_space = _action_space(system)
        self._system = system
        self._history_length = history
        self._history: FrameHistory | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of all chance from here on; without it the previous generator is used further.
            options: `{"start": {...}}` sets the start state, see the system's `reset`.
        """
        super().reset(seed=seed)
        given = _check_options(options, ("start",))
        frames = self._system.reset(self.np_random, start=given.get("start"))
        self._history = FrameHistory(frames, self._history_length)
        return self._observation(), {}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; actions are clipped to [-1, 1]. The reward is that of the new state."""
        if self._history is None:
            raise ValueError("step was called before reset; reset the environment first.")
        frames, rewards = self._system.step(np.asarray(action, dtype=np.float64)[None])
        self._history.push(frames)
        return self._observation(), float(rewards[0]), False, False, {}

    def _observation(self) -> Observation:
        assert self._history is not None
        observation: Observation = self._history.window[0].astype(np.float32).reshape(-1)
        return observation


class SystemVectorEnv(VectorEnv[Observation, NDArray[np.floating], NDArray[Any]]):
    """Many copies, stepped together in NumPy.

    Args:
        system: N copies.
        space: of a copy's observations.
        history: frames in an observation.
        max_episode_steps: steps after which a copy's episode is truncated; None for never.
        autoreset_mode: Gymnasium's meaning; "Disabled" allows `options={"reset_mask": ...}`.
        render_mode: only None.
    """

    def __init__(
        self,
        system: EndlessSystem,
        space: spaces.Space[Any],
        history: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
        render_mode: str | None,
    ) -> None:
        _check_render_mode(render_mode)
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps is {max_episode_steps}; give at least 1 or None.")
        self.num_envs = system.copies
        self.render_mode = render_mode
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self.single_observation_space = space
        self.single_action_space = _action_space(system)
        self._system = system
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._history_length = history
        self._limit = max_episode_steps
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)
        self._history: FrameHistory | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: of all chance from here on; without it the previous generator is used further.
            options: `{"start": {...}}` sets the start state (numbers, or arrays over the copies
                that start); `{"reset_mask": [N] bool}` starts only some.
        """
        super().reset(seed=seed)
        given = _check_options(options, ("start", "reset_mask"))
        mask = given.get("reset_mask")
        if mask is None:
            frames = self._system.reset(self.np_random, start=given.get("start"))
            self._history = FrameHistory(frames, self._history_length)
            self._elapsed[:] = 0
            self._ended[:] = False
        else:
            chosen = np.asarray(mask)
            if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_:
                raise ValueError(f"reset_mask must be {self.num_envs} booleans.")
            self._restart(chosen, given.get("start"))
        return self._observation(), {}

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One step of all copies; one that is due for an autoreset ignores its action."""
        history = self._running()
        frames, rewards = self._system.step(actions)
        history.push(frames)
        self._elapsed += 1
        if self._mode is AutoresetMode.NEXT_STEP and self._ended.any():
            rewards[self._ended] = 0.0
            self._restart(self._ended)
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        if self._limit is not None:
            truncated = self._elapsed >= self._limit
        self._ended = truncated
        info: dict[str, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP and truncated.any():
            final = np.full(self.num_envs, None, dtype=object)
            observations = self._observation()
            for index in np.flatnonzero(truncated):
                final[index] = observations[index]
            empty = {"final_info": {}, "_final_info": truncated.copy()}
            info = {"final_obs": final, "_final_obs": truncated.copy(), **empty}
            self._restart(truncated)
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        return self._observation(), rewards, terminated, truncated.copy(), info

    def _running(self) -> FrameHistory:
        if self._history is None:
            raise ValueError("the environment has not been started; reset all copies first.")
        return self._history

    def _restart(self, copies: NDArray[np.bool_], start: Mapping[str, Any] | None = None) -> None:
        history = self._running()
        frames = self._system.reset_copies(copies, self.np_random, start=start)
        history.restart(copies, frames)
        self._elapsed[copies] = 0
        self._ended = self._ended & ~copies

    def _observation(self) -> Observation:
        window = self._running().window
        return window.astype(np.float32).reshape(self.num_envs, -1)
