"""The settings with which policies are evaluated on the real system."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from components.policies.proximities import check_proximity_step, proximity_grid

__all__ = ["EvaluationProtocol"]


@dataclass(frozen=True, kw_only=True)
class EvaluationProtocol:
    """The protocol (thesis 5.1.2; details in docs/protocol.md)."""

    trajectories: int = 10  # real ones per policy and proximity
    horizon: int = 100  # steps
    proximity_step: float = 0.05  # of the grid of proximities, from 0 to 1
    discount: float | None = None  # gamma of the reported returns; None: the log's own

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the field and its range.
        """
        if self.trajectories < 1 or self.horizon < 1:
            raise ValueError(
                "trajectories and horizon must be at least 1, got "
                f"{self.trajectories} and {self.horizon}."
            )
        check_proximity_step(self.proximity_step)
        if self.discount is not None and not 0 < self.discount <= 1:
            raise ValueError(
                f"discount must lie in (0, 1], or be null for the log's own; got {self.discount}."
            )

    @property
    def proximities(self) -> tuple[float, ...]:
        """The grid 0, step, ..., 1."""
        return proximity_grid(self.proximity_step)

    def record(self, discount: float) -> dict[str, Any]:
        """What identifies an evaluation, under the names that stored results have.

        Args:
            discount: Of the log, which is that of the reported returns unless another was chosen.
        """
        return {
            "trajectories": self.trajectories,
            "horizon": self.horizon,
            "lambda_step": self.proximity_step,
            "discount": discount if self.discount is None else self.discount,
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> tuple["EvaluationProtocol", float]:
        """The protocol of a record, and the discount of the reported returns.

        Raises:
            ValueError: A value outside its range.
        """
        protocol = cls(
            trajectories=record["trajectories"],
            horizon=record["horizon"],
            proximity_step=record["lambda_step"],
        )
        return protocol, record["discount"]
