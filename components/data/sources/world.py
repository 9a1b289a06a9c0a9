"""The dataset of the 2-D world: its settings and its generation (thesis 6.5).

The thesis prints 40 trajectories and 1,000 interactions. The set that its authors ship has 400 of
25 steps, which are taken: with a tenth of them, models do not learn the plane.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from components.core.random_streams import lane_generator, lane_key
from components.data.assembly import assemble
from components.data.controllers.world import to_nearest
from components.data.dataset import OfflineDataset
from components.data.sources.ranges import check_exploration_and_discount
from components.environments.systems import WORLD
from components.environments.world.plane import COORDINATES, STEPS, Plane

__all__ = ["WorldSpec"]

Point = tuple[float, float]


@dataclass(frozen=True)
class WorldSpec:
    """Settings of a dataset of the 2-D world.

    Attributes:
        name: part of the random stream's identity.
        goals: the logging controller goes to the nearest of them.
        epsilon: probability per step that the whole action is uniform, 0 ... 1.
        episodes: their number; called so because `data.trajectories` sizes other systems.
        length: steps of an episode.
        discount: of the returns on the card.

    Raises:
        ValueError: a value outside its range.
    """

    name: str
    goals: tuple[Point, ...] = ((2.5, 2.5), (7.5, 7.5))
    epsilon: float = 0.1
    episodes: int = 400
    length: int = 25
    discount: float = 0.99

    def __post_init__(self) -> None:
        if not self.goals:
            raise ValueError("goals is empty; give at least one point.")
        check_exploration_and_discount(self.epsilon, self.discount)
        if self.episodes < 2 or self.length < 1:
            raise ValueError(
                f"{self.episodes} episodes of {self.length} steps make no dataset; give two "
                "episodes of a step at least."
            )

    @property
    def identity(self) -> Mapping[str, Any]:
        """All its fields."""
        return asdict(self)

    @property
    def environment(self) -> str:
        """Gymnasium id of the system."""
        return WORLD.id

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """Its parameters: none."""
        return {}

    @property
    def history(self) -> int:
        """Frames in an observation: a position is the whole state."""
        return 1

    @property
    def steps(self) -> int:
        """Steps of every episode."""
        return self.length

    @property
    def transitions(self) -> int:
        """Steps in all."""
        return self.episodes * self.length

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of stored artifacts that it is made with: none."""
        return {}

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset, in one thread; the same bytes for the same specification and seed."""
        key = lane_key("world dataset", self.name, seed)
        starts, exploration = (lane_generator(lane_key(key, of)) for of in ("start", "exploration"))
        plane = Plane(self.episodes)
        frames = np.empty((self.episodes, self.length + 1, len(COORDINATES)), np.float32)
        actions = np.empty((self.episodes, self.length, len(STEPS)), np.float32)
        rewards = np.empty((self.episodes, self.length), np.float32)
        positions = plane.reset(starts)
        frames[:, 0] = positions
        for step in range(self.length):
            explores = exploration.random(self.episodes) < self.epsilon
            anywhere = exploration.uniform(-1.0, 1.0, (self.episodes, len(STEPS)))
            wanted = to_nearest(positions, self.goals)
            actions[:, step] = np.where(explores[:, None], anywhere, wanted)
            # as stored, so that the logged action is the one that was executed
            positions, rewards[:, step] = plane.step(actions[:, step])
            frames[:, step + 1] = positions
        truncated = np.zeros((self.episodes, self.length), dtype=np.bool_)
        truncated[:, -1] = True
        arrays = {
            "frames": frames.reshape(-1, len(COORDINATES)),
            "actions": actions.reshape(-1, len(STEPS)),
            "rewards": rewards.reshape(-1),
            "terminated": np.zeros(self.transitions, dtype=np.bool_),
            "truncated": truncated.reshape(-1),
            "episode_starts": np.arange(self.episodes + 1, dtype=np.int64) * self.length,
        }
        return assemble(
            arrays,
            discount=self.discount,
            name=self.name,
            environment=self.environment,
            environment_parameters=self.environment_parameters,
            controller="to_nearest",
            epsilon=self.epsilon,
            seed=seed,
            history=self.history,
            frame_features=COORDINATES,
            action_features=STEPS,
            dynamics=WORLD.dynamics,
        )
