"""The Industrial Benchmark behind Gymnasium's interfaces, single and vectorised.

An observation is the last frames (30 by default), newest first, flattened frame by frame, float32.
At the start of an episode the first frame is repeated in the place of missing ones. The machine
never terminates; episodes end by time-out, if at all.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from components.environments.frame_history import HISTORY_LENGTH, FrameHistory
from components.environments.industrial.benchmark import (
    FRAME_FEATURES,
    STEERINGS,
    IndustrialBenchmark,
)

__all__ = ["IndustrialBenchmarkEnv", "IndustrialBenchmarkVectorEnv"]

Observation = NDArray[np.float32]

# fatigue cannot pass 300; consumption's bounds are a hundred deviations beyond what it can reach
_FRAME_LOW = (0.0, 0.0, 0.0, 0.0, 0.0, -200.0)
_FRAME_HIGH = (100.0, 100.0, 100.0, 100.0, 301.0, 10_000.0)


def _observation_space(history: int) -> spaces.Space[Any]:
    if history < 1:
        raise ValueError(f"history is {history} frames; give at least 1.")
    low = np.tile(np.array(_FRAME_LOW, dtype=np.float32), history)
    high = np.tile(np.array(_FRAME_HIGH, dtype=np.float32), history)
    return spaces.Box(low, high, dtype=np.float32)


def _action_space() -> spaces.Space[Any]:
    return spaces.Box(-1.0, 1.0, (len(STEERINGS),), dtype=np.float32)


def _check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    given = dict(options or {})
    for name in given:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r}; known are {', '.join(known)}.")
    return given


class IndustrialBenchmarkEnv(gym.Env[Observation, NDArray[np.floating]]):
    """A single Industrial Benchmark.

    Args:
        setpoint: load demanded from the machine, 0 ... 100.
        history: frames in an observation; 1 gives the newest frame alone.
        render_mode: the machine cannot be rendered; only None.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - declared so by Gymnasium

    def __init__(
        self,
        setpoint: float = 70.0,
        history: int = HISTORY_LENGTH,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render mode {render_mode!r} does not exist; use None.")
        self.render_mode = render_mode
        self.observation_space = _observation_space(history)
        self.action_space = _action_space()
        self._history_length = history
        self._machine = IndustrialBenchmark(1, setpoint)
        self._history: FrameHistory | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of all noise from here on; without it the previous generator is used further.
            options: `{"start": {...}}` sets the start state, see `IndustrialBenchmark.reset`.
        """
        super().reset(seed=seed)
        given = _check_options(options, ("start",))
        frames = self._machine.reset(self.np_random, start=given.get("start"))
        self._history = FrameHistory(frames, self._history_length)
        return self._observation(), {}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; actions are clipped to [-1, 1]. The reward is that of the new state."""
        if self._history is None:
            raise ValueError("step was called before reset; reset the environment first.")
        frames, rewards = self._machine.step(np.asarray(action, dtype=np.float64)[None])
        self._history.push(frames)
        return self._observation(), float(rewards[0]), False, False, {}

    def state(self) -> dict[str, Any]:
        """The hidden state, see `IndustrialBenchmark.state`."""
        return self._machine.state()

    def _observation(self) -> Observation:
        assert self._history is not None
        observation: Observation = self._history.window[0].astype(np.float32).reshape(-1)
        return observation


class IndustrialBenchmarkVectorEnv(VectorEnv[Observation, NDArray[np.floating], NDArray[Any]]):
    """Many machines of one setpoint, stepped together in NumPy.

    Args:
        num_envs: number of machines N.
        setpoint: load demanded from every machine, 0 ... 100.
        history: frames in an observation.
        max_episode_steps: steps after which a machine's episode is truncated; None for never.
        autoreset_mode: Gymnasium's meaning; "Disabled" allows `options={"reset_mask": ...}`.
        render_mode: only None.
    """

    def __init__(
        self,
        num_envs: int = 1,
        setpoint: float = 70.0,
        history: int = HISTORY_LENGTH,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render mode {render_mode!r} does not exist; use None.")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps is {max_episode_steps}; give at least 1 or None.")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self.single_observation_space = _observation_space(history)
        self.single_action_space = _action_space()
        self._machines = IndustrialBenchmark(num_envs, setpoint)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._history_length = history
        self._limit = max_episode_steps
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._history: FrameHistory | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: of all noise from here on; without it the previous generator is used further.
            options: `{"start": {...}}` sets the start state (numbers, or arrays over the machines
                that start); `{"reset_mask": [N] bool}` starts only some.
        """
        super().reset(seed=seed)
        given = _check_options(options, ("start", "reset_mask"))
        mask = given.get("reset_mask")
        if mask is None:
            frames = self._machines.reset(self.np_random, start=given.get("start"))
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
        """One step of all machines; a machine due for an autoreset ignores its action."""
        history = self._running()
        frames, rewards = self._machines.step(actions)
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

    def state(self) -> dict[str, Any]:
        """The hidden state, see `IndustrialBenchmark.state`."""
        return self._machines.state()

    def _running(self) -> FrameHistory:
        if self._history is None:
            raise ValueError("the environment has not been started; reset all machines first.")
        return self._history

    def _restart(self, copies: NDArray[np.bool_], start: Mapping[str, Any] | None = None) -> None:
        history = self._running()
        frames = self._machines.reset_copies(copies, self.np_random, start=start)
        history.restart(copies, frames)
        self._elapsed[copies] = 0
        self._ended = self._ended & ~copies

    def _observation(self) -> Observation:
        window = self._running().window
        return window.astype(np.float32).reshape(self.num_envs, -1)


assert len(FRAME_FEATURES) == len(_FRAME_LOW) == len(_FRAME_HIGH)
