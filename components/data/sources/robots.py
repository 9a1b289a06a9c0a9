"""Robot datasets: their settings and their generation.

Source: thesis section 3.1.2 and the "imperfect demonstrations" of Fujimoto et al., "Off-Policy Deep
Reinforcement Learning without Exploration" (2019): an expert trained online by DDPG acts with
Gaussian noise, and three actions in ten are uniformly random. The authors' repository collects
100,000 steps for this task; the thesis says 1,000,000, which are taken.

Episodes end with a fall, which is terminal, or by time-out, which is not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from components.core.random_streams import lane_key
from components.data.assembly import assemble
from components.data.controllers.trained.shipped import SHIPPED, Expert
from components.data.dataset import OfflineDataset
from components.data.sources.ranges import check_exploration_and_discount
from components.data.sources.robot_collection import (
    Episode,
    Exploration,
    collect_episodes,
    episode_arrays,
)
from components.environments.mujoco.specifications import PHYSICS, ROBOTS, simulator_version

if TYPE_CHECKING:
    from components.environments.mujoco.robots import Robots

__all__ = ["RobotSpec"]

_COPIES: Final = 100  # stepped together; the log does not depend on their number


@dataclass(frozen=True)
class RobotSpec:
    """Settings of a robot dataset.

    Attributes:
        name: part of the random stream's identity.
        robot: one of `ROBOTS`, whose expert ships.
        epsilon: probability per step that the whole action is uniform, 0 ... 1.
        noise: deviation of the Gaussian noise on the expert's own actions.
        transitions: steps in all.
        steps: time limit of an episode.
        physics: variant of the system, "v3" or "v5".
        discount: of the returns on the card.

    Raises:
        ValueError: a value outside its range.
    """

    name: str
    robot: str
    epsilon: float = 0.3
    noise: float = 0.3
    transitions: int = 1_000_000
    steps: int = 1000
    physics: str = "v3"
    discount: float = 0.99

    def __post_init__(self) -> None:
        for value, what, known in (
            (self.robot, "robot", tuple(ROBOTS)),
            (self.physics, "physics", PHYSICS),
        ):
            if value not in known:
                raise ValueError(f"unknown {what} {value!r}; known are {', '.join(known)}.")
        check_exploration_and_discount(self.epsilon, self.discount)
        if self.noise < 0.0:
            raise ValueError(f"noise is {self.noise}; give a number from 0.")
        if self.transitions < 1 or self.steps < 1:
            raise ValueError(
                f"{self.transitions} transitions in episodes of {self.steps} steps make no "
                "dataset; both must be at least 1."
            )

    @property
    def identity(self) -> Mapping[str, Any]:
        """All its fields."""
        return asdict(self)

    @property
    def environment(self) -> str:
        """Gymnasium id of the system."""
        return ROBOTS[self.robot].id

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """Its parameters."""
        return {"physics": self.physics}

    @property
    def history(self) -> int:
        """Frames in an observation: a single one shows the whole state."""
        return 1

    @property
    def ingredients(self) -> Mapping[str, str]:
        """The digest of the expert that ships with this package.

        Raises:
            FileNotFoundError: it is missing.
            ValueError: it is damaged, or was trained in the other physics.
        """
        return {"expert": self._expert().card.digest}

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset; the same bytes for the same specification, expert and seed.

        Raises:
            FileNotFoundError: the robot's expert is missing.
            ValueError: the expert is damaged or was trained on another robot.
        """
        expert = self._expert()
        from components.environments.mujoco.robots import Robots  # MuJoCo is slow to import

        robots = Robots(ROBOTS[self.robot], _COPIES, self.physics, threads)
        if expert.policy.card.features != tuple(robots.frame_features):
            raise ValueError(
                f"the expert of {expert.card.robot} does not know the frames of "
                f"{self.environment}; train one with "
                f"`python -m flows.train_experts robots=[{self.robot}] install=true`."
            )
        episodes = collect_episodes(
            expert.act,
            robots,
            Exploration(self.epsilon, self.noise),
            horizon=self.steps,
            transitions=self.transitions,
            key=lane_key("robot dataset", self.name, seed),
        )
        return _assemble(self, seed, expert, robots, episodes)

    def _expert(self) -> Expert:
        expert = Expert.load(SHIPPED / self.robot)
        if expert.card.physics != self.physics:
            raise ValueError(
                f"the expert of {self.robot} was trained in the physics {expert.card.physics}, not "
                f"{self.physics}; train one with `python -m flows.train_experts "
                f"robots=[{self.robot}] physics={self.physics} install=true`."
            )
        return expert


def _assemble(
    spec: RobotSpec, seed: int, expert: Expert, robots: "Robots", episodes: Sequence[Episode]
) -> OfflineDataset:
    """Make a dataset of episodes and write its card."""
    return assemble(
        episode_arrays(episodes),
        discount=spec.discount,
        name=spec.name,
        environment=spec.environment,
        environment_parameters=spec.environment_parameters,
        controller="expert",
        controller_digest=expert.card.digest,
        epsilon=spec.epsilon,
        noise=spec.noise,
        seed=seed,
        history=spec.history,
        frame_features=tuple(robots.frame_features),
        action_features=tuple(robots.action_features),
        dynamics=ROBOTS[spec.robot].dynamics,
        simulator=simulator_version(),
    )
