"""The settings with which policies are evaluated on the real system."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from components.policies.proximities import check_proximity_step, proximity_grid

__all__ = ["EvaluationProtocol"]


@dataclass(frozen=True, kw_only=True)
class EvaluationProtocol:
    """The protocol (thesis 5.1.2; details in the README). The discount belongs to the dataset."""

    trajectories: int = 10  # real ones per policy and proximity
    horizon: int = 100  # steps
    proximity_step: float = 0.05  # of the grid of proximities, from 0 to 1

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

    @property
    def proximities(self) -> tuple[float, ...]:
        """The grid 0, step, ..., 1."""
        return proximity_grid(self.proximity_step)

    def record(self, discount: float) -> dict[str, Any]:
        """What identifies an evaluation, under the names that stored results have.

        Args:
            discount: Gamma of the reported return.
        """
        return {
            "trajectories": self.trajectories,
            "horizon": self.horizon,
            "lambda_step": self.proximity_step,
            "discount": discount,
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> tuple["EvaluationProtocol", float]:
        """The protocol and the discount of a record.

        Raises:
            ValueError: A value outside its range.
        """
        protocol = cls(
            trajectories=record["trajectories"],
            horizon=record["horizon"],
            proximity_step=record["lambda_step"],
        )
        return protocol, record["discount"]
