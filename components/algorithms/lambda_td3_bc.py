"""lambda-TD3+BC: TD3+BC whose trade-off between value and imitation is an input at run time.

The model-free comparison of thesis 6.5 (equation 6.9) and of Swazinna, Udluft, Runkler,
"User-Interactive Offline Reinforcement Learning" (2022). Actor and critics are given the proximity
parameter lambda beside the observation; each logged transition draws its own
``lambda ~ Beta(0.1, 0.1)``, the same one for both of its states, and the actor minimises

    mean [-lambda alpha Q_1(s, pi, lambda) / mean|Q_1| + (1 - lambda) (pi - a)^2]

for ``pi = pi(s, lambda)``, with the squared distance averaged over action entries. All else is
TD3+BC, see :mod:`components.algorithms.td3_bc`.

Deviations: frames are standardised, which the authors' code leaves out here; the proximity enters
the networks standardised, as in LION.
"""

from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from components.algorithms import td3_bc
from components.algorithms.parts.algorithm import Algorithm
from components.algorithms.parts.learner import LearnerInputs, needed
from components.core.draws import Beta, Draw
from components.data.batches import Batch
from components.networks import lanewise_mean
from components.policies.policy import PROXIMITY_SCALING

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config(td3_bc.Config):
    """TD3+BC's settings, and how the proximity is drawn."""

    beta: float = 0.1  # both parameters of the proximity's Beta distribution

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        super().__post_init__()
        if self.beta <= 0:
            raise ValueError("beta must be positive.")


class Learner(td3_bc.Learner):
    """A stack of lambda-TD3+BC learners, one lane per (dataset, seed)."""

    _further_inputs = 1

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        super().__init__(config, inputs)
        self._proximity_scaling = PROXIMITY_SCALING.to(inputs.data.device)

    def _draws(self) -> dict[str, Draw]:
        shape = self._config.batch
        beta = self._config.beta  # type: ignore[attr-defined]
        return super()._draws() | {"proximity": Beta(beta, shape)}

    # -- networks ---------------------------------------------------------------------------

    def _with_proximity(self, observations: Tensor, proximity: Tensor) -> Tensor:
        """Observations ``[L, B, O + 1]`` with the scaled ``proximity [L, B]`` as last entry."""
        scaled = self._proximity_scaling.apply(proximity[..., None])
        return torch.cat([observations, scaled], dim=-1)

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        return super().act(self._with_proximity(observations, needed(proximity, "proximity")))

    # -- losses -----------------------------------------------------------------------------

    def _batch(self, drawn: dict[str, Tensor]) -> Batch:
        batch = super()._batch(drawn)
        return replace(
            batch,
            observations=self._with_proximity(batch.observations, drawn["proximity"]),
            next_observations=self._with_proximity(batch.next_observations, drawn["proximity"]),
        )

    def _weigh(self, batch: Batch, gain: Tensor, distance: Tensor) -> Tensor:
        proximity = self._proximity_scaling.invert(batch.observations[..., -1:]).squeeze(-1)
        return lanewise_mean((1.0 - proximity) * distance - proximity * gain)


ALGORITHM: Final = Algorithm(
    name="lambda_td3_bc",
    config=Config,
    learner=Learner,
    version=2,
    cost=td3_bc.ALGORITHM.cost,
    takes_proximity=True,
    frame_epsilon=td3_bc.ALGORITHM.frame_epsilon,
)
