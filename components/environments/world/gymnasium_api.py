"""The 2-D world behind Gymnasium's interfaces, single and vectorised.

See :mod:`components.environments.gymnasium_base`; an observation is a position.
"""

import numpy as np
from gymnasium.vector import AutoresetMode

from components.environments.gymnasium_base import SingleEnv, SystemVectorEnv, observation_space
from components.environments.world.plane import COORDINATES, Plane

__all__ = ["WorldEnv", "WorldVectorEnv"]

_FAR = float(np.finfo(np.float32).max)  # positions have no bounds
_BOUNDS = (-_FAR,) * len(COORDINATES), (_FAR,) * len(COORDINATES)


class WorldEnv(SingleEnv):
    """A single agent.

    Args:
        render_mode: `python -m flows.study world` draws it; here only None.
    """

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(Plane(1), observation_space(*_BOUNDS, 1), 1, render_mode)


class WorldVectorEnv(SystemVectorEnv):
    """Many agents, stepped together in NumPy.

    Args:
        num_envs: number of agents N.
        max_episode_steps: steps after which an agent's episode is truncated; None for never.
        autoreset_mode: Gymnasium's meaning; "Disabled" allows `options={"reset_mask": ...}`.
        render_mode: only None.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        space = observation_space(*_BOUNDS, 1)
        system = Plane(num_envs)
        super().__init__(system, space, 1, max_episode_steps, autoreset_mode, render_mode)
