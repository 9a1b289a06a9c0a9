"""How the three kinds of one-step ensembles are built and trained.

They share every setting a search may vary; the class of a kind fixes what distinguishes it.
"""

from dataclasses import dataclass
from typing import ClassVar

from components.models.supervised import SCHEDULES

__all__ = [
    "DeterministicEnsembleConfig",
    "GaussianEnsembleConfig",
    "MLPEnsembleConfig",
    "ResidualEnsembleConfig",
]


@dataclass(frozen=True, kw_only=True)
class MLPEnsembleConfig:
    """Settings of any kind.

    Attributes:
        activation: Name in :data:`components.models.mlp_ensemble.ensemble.ACTIVATIONS`.
        gaussian: Whether members predict a variance and maximise the likelihood, or else minimise
            the mean squared error.
        weight_norm: Whether weights are learned as directions and lengths.
        bootstrap: Whether every member learns from its own resampling of the transitions.
        decay_shares: Factors of the weight decay, from the first layer on; further hidden layers
            have the last but one, the output layer has the last.
    """

    activation: ClassVar[str] = "relu"
    gaussian: ClassVar[bool] = False
    weight_norm: ClassVar[bool] = False
    bootstrap: ClassVar[bool] = False
    decay_shares: ClassVar[tuple[float, ...]] = (1.0, 1.0)

    members: int = 4  # K
    elites: int = 0  # members of lowest held-out error that are followed; 0: all
    hidden: tuple[int, ...] = (400, 300)  # layer widths
    history: int = 0  # frames read, newest first; 0: as many as the dataset's observations have
    target: str = "auto"  # predicted: value, change, or auto: that of lower held-out error
    epochs: int = 16  # passes over the training transitions; training may stop earlier
    batch: int = 500  # transitions per update and member
    learning_rate: float = 3e-4  # Adam, at the start
    schedule: str = "cosine"  # falling to zero over the epochs; or constant
    weight_decay: float = 0.0  # L2 term of the weights
    holdout: float = 0.1  # last fraction of the trajectories, never trained on
    patience: int = 0  # epochs without improvement of any member before stopping; 0: never stop
    improvement: float = 0.0  # smallest relative improvement of a held-out error that counts

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        if min(self.members, self.epochs, self.batch, *self.hidden) < 1:
            raise ValueError("members, epochs, batch and every hidden width must be at least 1.")
        if min(self.elites, self.history, self.patience) < 0 or self.elites > self.members:
            raise ValueError(
                "elites, history and patience must not be negative, elites at most members."
            )
        if self.target not in ("value", "change", "auto") or self.schedule not in SCHEDULES:
            raise ValueError(
                f"target must be value, change or auto and schedule one of {', '.join(SCHEDULES)}."
            )
        if self.learning_rate <= 0 or self.weight_decay < 0:
            raise ValueError("learning_rate must be positive and weight_decay not negative.")
        if not 0 < self.holdout < 1 or not 0 <= self.improvement < 1:
            raise ValueError("holdout must lie in (0, 1) and improvement in [0, 1).")

    @property
    def forms(self) -> tuple[str, ...]:
        """Target forms that are trained."""
        return ("value", "change") if self.target == "auto" else (self.target,)

    @property
    def decays(self) -> tuple[float, ...]:
        """Weight decay of every layer, input to output."""
        *first, last = self.decay_shares
        inner = [*first, *[first[-1]] * len(self.hidden)][: len(self.hidden)]
        return tuple(self.weight_decay * share for share in (*inner, last))


@dataclass(frozen=True, kw_only=True)
class DeterministicEnsembleConfig(MLPEnsembleConfig):
    """MOOSE's transition models (thesis 5.1.2): 400-300, weights normalised.

    The thesis trains for 50 epochs at a constant 1e-4, which takes three times as long to a
    slightly higher held-out error (0.1332 against 0.1321 on mediocre-0.4).
    """

    weight_norm: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class GaussianEnsembleConfig(MLPEnsembleConfig):
    """MOPO's (its authors' code): Gaussian members, bootstrapped, stopped early.

    The authors train at a constant rate for as long as errors fall; on mediocre-0.4 that ends after
    twelve epochs (0.1335), while ten at a falling rate reach 0.1284.
    """

    activation: ClassVar[str] = "swish"
    gaussian: ClassVar[bool] = True
    bootstrap: ClassVar[bool] = True
    decay_shares: ClassVar[tuple[float, ...]] = (0.25, 0.5, 0.75, 1.0)

    members: int = 7
    elites: int = 5
    hidden: tuple[int, ...] = (200, 200, 200, 200)
    target: str = "change"
    epochs: int = 10
    batch: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4  # of the output layer; less before it, see decay_shares
    patience: int = 5
    improvement: float = 0.01


@dataclass(frozen=True, kw_only=True)
class ResidualEnsembleConfig(MLPEnsembleConfig):
    """MOReL's (its authors' code): wide deterministic members that predict changes.

    The authors train for 25 epochs at a constant rate. After the fifth of them nothing improves
    any more on mediocre-0.4 (0.140); eight at a falling rate reach 0.134.
    """

    hidden: tuple[int, ...] = (512, 512)
    target: str = "change"
    epochs: int = 8
    batch: int = 256
    learning_rate: float = 1e-3
