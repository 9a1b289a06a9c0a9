"""The interface of fitted ensembles in which policies are unrolled."""

from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from components.core.normaliser import Normaliser

__all__ = ["Prediction", "TransitionModel"]


@dataclass(frozen=True)
class Prediction:
    """Predictions of all members for the next model frame.

    Attributes:
        values: ``[L, D, K, B]`` normalised targets, not clipped.
        spread: ``[L, D, K, B]`` predicted standard deviations in units of a standardised target;
            None for deterministic members.
    """

    values: Tensor
    spread: Tensor | None = None


class TransitionModel(Protocol):
    """Ensembles of L lanes, K members each.

    Attributes:
        members: K.
        memory: G, model frames up to the start that :meth:`begin` reads.
        frames: Scaling of a model frame's features, ``[L, M]``.
        low: Smallest normalised targets of the training data, ``[L, D]``.
        high: Largest.
        target_scale: One standardised target in normalised units, ``[L, D]``: 1 where values are
            predicted, the deviation of the changes where changes are.
    """

    members: int
    memory: int
    frames: Normaliser
    low: Tensor
    high: Tensor
    target_scale: Tensor

    def begin(self, past: Tensor) -> Any:
        """State after model frames, not scaled, ``[L, S, B, G, M]``, newest first; S is 1 or K."""

    def predict(
        self, state: Any, observation: Tensor, known: Tensor, own: Tensor
    ) -> tuple[Prediction, Any]:
        """Advance all members by a step.

        Args:
            state: Of :meth:`begin` or the step before.
            observation: ``[L, S, B, H * F]`` frames before the action, newest first, in the scaling
                the policies see.
            known: ``[L, S, B, M - D]`` normalised known features after the action.
            own: ``[L, D, S, B]`` normalised targets before the action.

        Returns:
            Member k's prediction for its own copy, or for the only one; the next state.
        """
