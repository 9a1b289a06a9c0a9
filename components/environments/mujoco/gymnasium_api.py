"""Single robots behind Gymnasium's interface: its own v5 classes with the choice of a physics.

They serve where one robot is looked at: rendering, Minari's specification of a dataset's
environment, and as the oracle of `Robots`. Like Gymnasium's own they do not clip actions.
"""

from typing import Any, ClassVar

import mujoco
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.swimmer_v5 import SwimmerEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv
from gymnasium.utils import EzPickle

from components.environments.mujoco.specifications import (
    HOPPER,
    SWIMMER,
    WALKER2D,
    Robot,
    load_model,
)

__all__ = ["HopperRobot", "SwimmerRobot", "Walker2dRobot"]


class _WithPhysics(MujocoEnv, EzPickle):
    """A robot of Gymnasium on the model of the chosen physics.

    Args:
        physics: "v3" as in the thesis, "v5" as in Gymnasium today.
        options: Gymnasium's own, such as `render_mode`.

    Raises:
        ValueError: a physics that does not exist.
    """

    robot: ClassVar[Robot]

    def __init__(self, physics: str = "v3", **options: Any) -> None:
        self._physics = physics
        super().__init__(**options)
        # a copy is made from these arguments, not from those of Gymnasium's class
        EzPickle.__init__(self, physics, **options)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = load_model(self.robot, self._physics)
        screen = model.vis.global_
        screen.offwidth = max(screen.offwidth, self.width)
        screen.offheight = max(screen.offheight, self.height)
        return model, mujoco.MjData(model)


class _Legged(_WithPhysics):
    """A robot that can fall."""

    is_healthy: bool
    _healthy_reward: float

    @property
    def healthy_reward(self) -> float:
        """In v3 also of the step that ends in a fall."""
        earned = self.is_healthy or self._physics == "v3"
        return earned * self._healthy_reward


class SwimmerRobot(_WithPhysics, SwimmerEnv):
    """One Swimmer."""

    robot = SWIMMER


class HopperRobot(_Legged, HopperEnv):
    """One Hopper."""

    robot = HOPPER


class Walker2dRobot(_Legged, Walker2dEnv):
    """One Walker2D."""

    robot = WALKER2D
