"""Industrial Benchmark datasets: their settings and their generation.

Source: thesis section 3.1.1. Three controllers, five amounts of exploration each, and one dataset
of exploration alone, which is the same for all three and is called mediocre-1.0 here (global-1.0
by its authors). Names are those of the thesis's tables.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from components.data.assembly import assemble
from components.data.controllers.industrial import CONTROLLERS
from components.data.dataset import OfflineDataset
from components.data.sources.industrial_collection import Log, collect
from components.data.sources.ranges import check_exploration_and_discount
from components.environments import INDUSTRIAL_BENCHMARK_ID
from components.environments.frame_history import HISTORY_LENGTH
from components.environments.industrial.benchmark import DYNAMICS, FRAME_FEATURES, STEERINGS

__all__ = ["IndustrialSpec", "dataset_from_log"]


@dataclass(frozen=True)
class IndustrialSpec:
    """Settings of an Industrial Benchmark dataset.

    Attributes:
        name: part of the random stream's identity.
        controller: one of `CONTROLLERS`.
        epsilon: probability per step that the whole action vector is random, 0 ... 1.
        setpoint: of the machine, 0 ... 100.
        trajectories: number of episodes.
        steps: transitions per episode.
        discount: of the returns on the card.

    Raises:
        ValueError: a value outside its range.
    """

    name: str
    controller: str
    epsilon: float
    setpoint: float = 70.0
    trajectories: int = 100
    steps: int = 1000
    discount: float = 0.97

    def __post_init__(self) -> None:
        if self.controller not in CONTROLLERS:
            known = ", ".join(CONTROLLERS)
            raise ValueError(f"unknown controller {self.controller!r}; known are {known}.")
        check_exploration_and_discount(self.epsilon, self.discount)
        if not 0.0 <= self.setpoint <= 100.0:
            raise ValueError(f"setpoint is {self.setpoint}; give a number from 0 to 100.")
        if self.trajectories < 1 or self.steps < 1:
            raise ValueError(
                f"{self.trajectories} trajectories of {self.steps} steps make no dataset; "
                "both must be at least 1."
            )

    @property
    def identity(self) -> Mapping[str, Any]:
        """All its fields."""
        return asdict(self)

    @property
    def environment(self) -> str:
        """Gymnasium id of the system."""
        return INDUSTRIAL_BENCHMARK_ID

    @property
    def environment_parameters(self) -> Mapping[str, Any]:
        """Its parameters."""
        return {"setpoint": self.setpoint}

    @property
    def history(self) -> int:
        """Frames in an observation: a single one shows the machine's state only in part."""
        return HISTORY_LENGTH

    @property
    def ingredients(self) -> Mapping[str, str]:
        """Digests of stored artifacts that it is made with: none."""
        return {}

    def generate(self, seed: int, threads: int = 1) -> OfflineDataset:
        """Make the dataset, in one thread; the same bytes for the same specification and seed."""
        noise, exploration = _generators(self.name, seed)
        log = collect(
            CONTROLLERS[self.controller],
            epsilon=self.epsilon,
            setpoint=self.setpoint,
            trajectories=self.trajectories,
            steps=self.steps,
            noise=noise,
            exploration=exploration,
        )
        return dataset_from_log(log, self, seed)


def _generators(name: str, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Generators of noise and exploration, a function of name and seed alone."""
    digest = hashlib.sha256(f"industrial-benchmark dataset {name} seed {seed}".encode()).digest()
    sequence = np.random.SeedSequence(int.from_bytes(digest, "little"))
    noise, exploration = (np.random.Generator(np.random.PCG64(s)) for s in sequence.spawn(2))
    return noise, exploration


def dataset_from_log(log: Log, spec: IndustrialSpec, seed: int) -> OfflineDataset:
    """Flatten a log and write its card."""
    e, t = log.rewards.shape
    truncated = np.zeros((e, t), dtype=np.bool_)
    truncated[:, -1] = True
    arrays = {
        "frames": log.frames.reshape(e * (t + 1), -1),
        "actions": log.actions.reshape(e * t, -1),
        "rewards": log.rewards.reshape(e * t),
        "terminated": np.zeros(e * t, dtype=np.bool_),
        "truncated": truncated.reshape(e * t),
        "episode_starts": np.arange(e + 1, dtype=np.int64) * t,
    }
    return assemble(
        arrays,
        discount=spec.discount,
        name=spec.name,
        environment=spec.environment,
        environment_parameters=spec.environment_parameters,
        controller=spec.controller,
        epsilon=spec.epsilon,
        seed=seed,
        history=spec.history,
        frame_features=FRAME_FEATURES,
        action_features=STEERINGS,
        dynamics=DYNAMICS,
    )
