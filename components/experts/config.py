"""Settings of an expert's training.

They are those of the "DDPG" of Fujimoto et al., "Off-Policy Deep Reinforcement Learning without
Exploration" (2019), whose imperfect demonstrations the thesis's robot data follow. `method=td3`
learns with twin critics, smoothed target actions and a delayed actor instead.
"""

from dataclasses import dataclass
from typing import Final

from components.algorithms import ddpg
from components.algorithms.parts.twin_delayed import TwinDelayedConfig
from components.core.options import option

__all__ = ["METHODS", "ExpertConfig"]

METHODS: Final[dict[str, type[ddpg.Config] | type[TwinDelayedConfig]]] = {
    "ddpg": ddpg.Config,
    "td3": TwinDelayedConfig,
}
"""By the name of a method the settings of its update."""


@dataclass(frozen=True, kw_only=True)
class ExpertConfig:
    """How an expert is trained."""

    steps: int = 1_000_000  # environment steps
    random_steps: int = 25_000  # of these uniformly random, before the first update
    exploration: float = 0.1  # deviation of the noise on the policy's actions
    horizon: int = 1000  # time limit of an episode, in steps
    evaluate_every: int = 5000  # steps
    episodes: int = 10  # of an evaluation
    hidden: tuple[int, ...] = (400, 300)  # layers of actor and critic
    learning_rate: float = 1e-3  # Adam, actor and critic
    batch: int = 100  # transitions per update
    discount: float = 0.99  # gamma
    target_rate: float = 0.005  # tau
    method: str = option("ddpg")  # or td3, for a robot that DDPG does not master

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the field and its range.
        """
        if self.method not in METHODS:
            raise ValueError(f"method is {self.method!r}; give one of {', '.join(METHODS)}.")
        if min(self.steps, self.horizon, self.evaluate_every, self.episodes) < 1:
            raise ValueError("steps, horizon, evaluate_every and episodes must be at least 1.")
        if not 1 <= self.random_steps <= self.steps:
            raise ValueError(
                f"random_steps is {self.random_steps}; give a number from 1 to steps={self.steps}."
            )
        if self.evaluate_every > self.steps:
            raise ValueError(
                f"evaluate_every={self.evaluate_every} is more than steps={self.steps}: no policy "
                "would be evaluated; lower it."
            )
        if self.exploration < 0:
            raise ValueError(f"exploration is {self.exploration}; give a number from 0.")
        _ = self.learner

    @property
    def learner(self) -> ddpg.Config | TwinDelayedConfig:
        """The settings of the update."""
        return METHODS[self.method](
            updates=self.steps,
            hidden=self.hidden,
            learning_rate=self.learning_rate,
            batch=self.batch,
            discount=self.discount,
            target_rate=self.target_rate,
        )
