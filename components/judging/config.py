"""The settings of all judges."""

from dataclasses import dataclass

from components.policies.proximities import check_proximity_step, proximity_grid

__all__ = ["JudgeConfig"]


@dataclass(frozen=True, kw_only=True)
class JudgeConfig:
    """How policies are judged from a log."""

    proximity_step: float = 0.1  # of the grid of proximities, from 0 to 1
    # virtual trajectories in an ensemble
    starts: int = 40  # logged states in which trajectories start
    start_window: int = 1  # they are among the first steps of each episode, so many
    # the log's support
    neighbours: int = 10_000  # logged transitions to which others are compared
    visited: int = 500  # states of the virtual trajectories that are compared
    quantile: float = 0.99  # of what is familiar that is said to be within the support
    # fitted Q evaluation
    updates: int = 2000
    hidden: tuple[int, ...] = (64, 64)
    batch: int = 256
    learning_rate: float = 1e-3  # Adam
    # tau, with which target networks follow: values reach about tau * updates steps ahead
    target_rate: float = 0.05
    replicas: int = 2  # networks a policy, of other weights and batches
    transitions: int = 50_000  # of the log at most, evenly spaced

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        counts = ("starts", "start_window", "neighbours", "visited", "updates", "batch", "replicas")
        for name in (*counts, "transitions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name at least one layer, of 1 or more: {self.hidden}.")
        if not 0 < self.quantile < 1:
            raise ValueError(f"quantile must lie between 0 and 1, got {self.quantile}.")
        if self.learning_rate <= 0 or not 0 < self.target_rate <= 1:
            raise ValueError("learning_rate must be above 0, target_rate in (0, 1].")
        check_proximity_step(self.proximity_step)

    @property
    def proximities(self) -> tuple[float, ...]:
        """The grid 0, step, ..., 1."""
        return proximity_grid(self.proximity_step)
