"""The Industrial Benchmark behind Gymnasium's interfaces, single and vectorised.

See :mod:`components.environments.gymnasium_base`; by default observations are the last 30 frames.
"""

from typing import Any

from gymnasium.vector import AutoresetMode

from components.environments.frame_history import HISTORY_LENGTH
from components.environments.gymnasium_base import SingleEnv, SystemVectorEnv, observation_space
from components.environments.industrial.benchmark import FRAME_FEATURES, IndustrialBenchmark

__all__ = ["IndustrialBenchmarkEnv", "IndustrialBenchmarkVectorEnv"]

# fatigue cannot pass 300; consumption's bounds are a hundred deviations beyond what it can reach
_BOUNDS = (0.0, 0.0, 0.0, 0.0, 0.0, -200.0), (100.0, 100.0, 100.0, 100.0, 301.0, 10_000.0)


class IndustrialBenchmarkEnv(SingleEnv):
    """A single Industrial Benchmark.

    Args:
        setpoint: load demanded from the machine, 0 ... 100.
        history: frames in an observation; 1 gives the newest frame alone.
        render_mode: the machine cannot be rendered; only None.
    """

    def __init__(
        self,
        setpoint: float = 70.0,
        history: int = HISTORY_LENGTH,
        render_mode: str | None = None,
    ) -> None:
        self._machine = IndustrialBenchmark(1, setpoint)
        super().__init__(self._machine, observation_space(*_BOUNDS, history), history, render_mode)

    def state(self) -> dict[str, Any]:
        """The hidden state, see `IndustrialBenchmark.state`."""
        return self._machine.state()


class IndustrialBenchmarkVectorEnv(SystemVectorEnv):
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
        self._machines = IndustrialBenchmark(num_envs, setpoint)
        space = observation_space(*_BOUNDS, history)
        super().__init__(
            self._machines, space, history, max_episode_steps, autoreset_mode, render_mode
        )

    def state(self) -> dict[str, Any]:
        """The hidden state, see `IndustrialBenchmark.state`."""
        return self._machines.state()


assert len(FRAME_FEATURES) == len(_BOUNDS[0]) == len(_BOUNDS[1])
