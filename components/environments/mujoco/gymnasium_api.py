"""Single robots behind Gymnasium's interface: its own v5 classes with the choice of a physics.

They are used for rendering, for Minari's specification of a dataset's environment, and as the
reference in tests of `Robots`. Like Gymnasium's own they do not clip actions.

Every robot of :data:`.specifications.ROBOTS` has its class here, e.g. `HopperRobot`.
"""

from functools import cache
from typing import Any, ClassVar

from components.environments.mujoco.engine import mujoco

# isort: split
# Gymnasium's classes import MuJoCo, too, so the engine comes first.
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.registration import load_env_creator
from gymnasium.utils import EzPickle

from components.environments.mujoco.specifications import ROBOTS, Robot, load_model

__all__ = ["robot_class"]


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
        """Healthy reward of the last step; in v3 also of the step that ends in a fall."""
        paid = self.is_healthy or self._physics == "v3"
        return paid * self._healthy_reward


@cache
def robot_class(name: str) -> type[MujocoEnv]:
    """The class of a robot by its short name; it pickles by its own name in this module."""
    robot = ROBOTS[name]
    kind: type = _WithPhysics if robot.health is None else _Legged
    theirs: Any = load_env_creator(robot.gymnasium_class)
    own = {"robot": robot, "__module__": __name__, "__doc__": f"One {robot.title}."}
    return type(robot.class_name, (kind, theirs), own)


def __getattr__(name: str) -> type[MujocoEnv]:
    """Classes by name, as Gymnasium's registry, pickle and Minari ask for them."""
    for robot in ROBOTS.values():
        if name == robot.class_name:
            return robot_class(robot.name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
