"""Specifications of the robots: MuJoCo models, observed features, rewards and falls.

The numbers are the defaults of Gymnasium's v5 classes. The thesis (section 3.2) used the third
version of these environments; `physics="v3"` restores it on today's MuJoCo:

- the healthy reward is paid on every step, also on the one that ends in a fall,
- Walker2D's right foot has the friction 0.9 (`walker2d.xml`),
- contact margins are halved: since MuJoCo 3.5 the margins of two geoms are added, before the larger
  one counted. Only Hopper's model has margins, and all of them are equal.

`physics="v5"` is Gymnasium's v5 untouched.
"""

import hashlib
import importlib.metadata
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

__all__ = [
    "HOPPER",
    "PHYSICS",
    "ROBOTS",
    "SWIMMER",
    "WALKER2D",
    "Health",
    "Robot",
    "load_model",
    "simulation_of",
    "simulator_version",
]

PHYSICS: Final = ("v3", "v5")
"""Versions of the robots: that of the thesis, and Gymnasium's newest."""

_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@dataclass(frozen=True, kw_only=True)
class Health:
    """The region outside of which a robot has fallen; all bounds are exclusive.

    Attributes:
        height: least and greatest height of the torso, in metres.
        angle: greatest absolute angle of the torso, in radians.
        state: greatest absolute value of every position and velocity but the first two positions.
    """

    height: tuple[float, float]
    angle: float
    state: float = math.inf

    def holds(
        self, positions: NDArray[np.float64], velocities: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """`[N]` whether a copy stands, from positions `[N, nq]` and velocities `[N, nv]`."""
        low, high = self.height
        height, rest = positions[:, 1], np.abs(positions[:, 2:])
        standing = (low < height) & (height < high) & (rest[:, 0] < self.angle)
        standing &= (rest < self.state).all(axis=1)
        standing &= (np.abs(velocities) < self.state).all(axis=1)
        return standing


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One kind of robot.

    Attributes:
        title: its name as Gymnasium writes it, e.g. "Hopper".
        gymnasium_class: Gymnasium's own class of a single one, "package.module:Class".
        models: MuJoCo model file of each physics, from Gymnasium.
        frame_features: names of the observed values (thesis tables 3.1, 3.3 and 3.5).
        action_features: names of the torques, each in [-1, 1] (tables 3.2, 3.4 and 3.6).
        unseen_positions: how many of the first positions, those in the plane, are not observed.
        velocity_limit: observed velocities are clipped to it.
        control_cost: weight of the squared action in the reward.
        healthy_reward: added to the reward of every step while it stands.
        health: the states in which it stands; None for a robot that cannot fall.
        reset_noise: half width of the uniform noise on a start's positions and velocities.
        normal_velocities: whether the noise on velocities is normal instead, with `reset_noise` as
            its deviation.
        substeps: steps of the simulator in a step of control.
    """

    title: str
    gymnasium_class: str
    models: Mapping[str, str]
    frame_features: tuple[str, ...]
    action_features: tuple[str, ...]
    unseen_positions: int = 1
    velocity_limit: float = 10.0
    control_cost: float = 1e-3
    healthy_reward: float = 1.0
    health: Health | None
    reset_noise: float = 5e-3
    normal_velocities: bool = False
    substeps: int = 4

    @property
    def name(self) -> str:
        """Short name, that of its dataset and of its expert's folder."""
        return self.title.lower()

    @property
    def id(self) -> str:
        """Gymnasium id of the system."""
        return f"proximity/{self.title}-v0"

    @property
    def class_name(self) -> str:
        """Name of its class in :mod:`.gymnasium_api`."""
        return f"{self.title}Robot"

    @property
    def dynamics(self) -> dict[str, Any]:
        """The dynamics specification: nothing is known without learning but the action itself.

        Returns:
            `known`: features that follow from the action, as clip(keep * old + scale * action, low,
            high); `learned`: those to be predicted; `reward`: weights of learned ones in the
            reward; of robots that can fall also `healthy`: the ranges of frame features, bounds
            excluded, within which they stand (None: no bound). Of the learners MOPO alone uses
            these, since its authors do.
        """
        actions, frame = self.action_features, self.frame_features
        section = {
            "known": {
                "features": list(actions),
                "keep": [0.0] * len(actions),
                "scale": [1.0] * len(actions),
                "low": -1.0,
                "high": 1.0,
            },
            "learned": [*frame, "reward"],
            "reward": {"reward": 1.0},
        }
        if self.health is None:
            return section
        height, angle, *others = frame  # the order of frames of robots that stand upright
        state = self.health.state
        limits = {height: self.health.height, angle: (-self.health.angle, self.health.angle)}
        limits |= dict.fromkeys(others, (-state, state))
        healthy = {
            name: [end if math.isfinite(end) else None for end in ends]
            for name, ends in limits.items()
            if any(map(math.isfinite, ends))
        }
        return section | {"healthy": healthy}


def _models(v3: str, v5: str) -> Mapping[str, str]:
    return MappingProxyType({"v3": v3, "v5": v5})


_LEG = ("thigh", "leg", "foot")
_LEGS = tuple(f"{side}_{part}" for side in ("right", "left") for part in _LEG)


def _standing_features(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Frame features of a robot that stands upright, of its rotor joints' names."""
    positions = ("torso_height", *(f"{part}_angle" for part in ("torso", *joints)))
    turning = (f"{part}_angular_velocity" for part in ("torso", *joints))
    return (*positions, "torso_velocity_x", "torso_velocity_z", *turning)


SWIMMER: Final = Robot(
    title="Swimmer",
    gymnasium_class="gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv",
    models=_models("swimmer.xml", "swimmer.xml"),
    frame_features=(
        "front_tip_angle",
        "first_rotor_angle",
        "second_rotor_angle",
        "tip_velocity_x",
        "tip_velocity_y",
        "front_tip_angular_velocity",
        "first_rotor_angular_velocity",
        "second_rotor_angular_velocity",
    ),
    action_features=("first_rotor_torque", "second_rotor_torque"),
    unseen_positions=2,
    velocity_limit=math.inf,
    control_cost=1e-4,
    healthy_reward=0.0,
    health=None,
    reset_noise=0.1,
)
"""Three segments in a viscous plane; swims along the x-axis and cannot fall."""

HOPPER: Final = Robot(
    title="Hopper",
    gymnasium_class="gymnasium.envs.mujoco.hopper_v5:HopperEnv",
    models=_models("hopper.xml", "hopper.xml"),
    frame_features=_standing_features(_LEG),
    action_features=tuple(f"{part}_torque" for part in _LEG),
    health=Health(height=(0.7, math.inf), angle=0.2, state=100.0),
)
"""One leg; hops along the x-axis."""

WALKER2D: Final = Robot(
    title="Walker2d",
    gymnasium_class="gymnasium.envs.mujoco.walker2d_v5:Walker2dEnv",
    models=_models("walker2d.xml", "walker2d_v5.xml"),
    frame_features=_standing_features(_LEGS),
    action_features=tuple(f"{part}_torque" for part in _LEGS),
    health=Health(height=(0.8, 2.0), angle=1.0),
)
"""Two legs; walks along the x-axis."""

ROBOTS: Final[Mapping[str, Robot]] = MappingProxyType(
    {robot.name: robot for robot in (SWIMMER, HOPPER, WALKER2D)}
)
"""All robots by short name, the only list of them."""


def load_model(robot: Robot, physics: str) -> "mujoco.MjModel":
    """Compile a robot's MuJoCo model.

    Raises:
        ValueError: a physics that does not exist.
    """
    if physics not in PHYSICS:
        raise ValueError(f"physics {physics!r} does not exist; choose {' or '.join(PHYSICS)}.")
    from components.environments.mujoco.engine import (
        mujoco,  # slow, and not needed for reading the records above
    )

    spec = mujoco.MjSpec.from_file(str(_ASSETS / robot.models[physics]))
    if physics == "v3":
        for geom in spec.geoms:
            geom.margin /= 2.0
    return spec.compile()


@cache
def simulator_version() -> str:
    """Name and version of the simulator, for the cards of what was made with it.

    They are those of the installed package, so that nothing has to be imported.
    """
    return f"mujoco {importlib.metadata.version('mujoco')}"


def simulation_of(robot: Robot) -> str:
    """What decides a robot's numbers: the simulator, and a digest of Gymnasium's model files."""
    files = sorted(set(robot.models.values()))
    content = hashlib.sha256(b"".join((_ASSETS / name).read_bytes() for name in files))
    return f"{simulator_version()} on {' and '.join(files)} {content.hexdigest()[:8]}"
