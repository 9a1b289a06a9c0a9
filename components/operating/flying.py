"""The autopilot as the driver of a session: trajectory after trajectory, each from a fresh start.

:class:`~components.evaluation.autopilot.Autopilot` decides at which proximity the next trajectory
is safe; here a session's steps are put together to the trajectories that it is told of.
"""

from typing import Final

from components.data.card import DatasetCard
from components.evaluation.autopilot import Autopilot, AutopilotConfig
from components.evaluation.guarantee import USUAL, Guarantee

__all__ = ["Flying", "usual_size"]

_BUDGET: Final = 60  # trajectories


class Flying:
    """A pilot of sessions.

    Args:
        card: Of the log: discount, length of a trajectory, and the return of the behaviour.
        guarantee: How careful it is.
    """

    def __init__(self, card: DatasetCard, guarantee: Guarantee = USUAL) -> None:
        self._discount, self._steps = card.discount, min(card.return_steps, card.steps)
        size = usual_size(card)
        self._search = Autopilot(
            AutopilotConfig(
                budget=_BUDGET, margin=guarantee.margin * size, slope=guarantee.slope * size
            )
        )
        self._taken, self._return = 0, 0.0
        self._proximity = 0.0

    @property
    def landed(self) -> bool:
        """Whether a trajectory has just ended, so that the next one needs a fresh start."""
        return self._taken == 0 and self._search.used > 0

    @property
    def promise(self) -> str:
        """What is guaranteed, and what that assumes, in a sentence."""
        config = self._search.config
        return (
            f"With {1 - config.risk:.0%} probability no trajectory's mean return lies more than "
            f"{config.margin:.2g} below the behaviour's, if the return falls by at most "
            f"{config.slope:.2g} per unit of λ and scatters nowhere more than at λ = 0."
        )

    @property
    def said(self) -> str:
        """What it is doing, in a sentence."""
        used = self._search.used
        if self._search.propose() is None:
            found = self._search.result()
            return (
                f"Autopilot: it stays at λ = {found.proximity:.2f}, mean return {found.mean:.1f} "
                f"after {used} trajectories, because {found.why}."
            )
        begun = f"Autopilot: trajectory {used + 1} of {_BUDGET} at λ = {self._proximity:.2f}"
        warm = used < self._search.config.warm_up
        return f"{begun}; {'it measures the familiar first' if warm else 'as far as is safe'}."

    def propose(self) -> float:
        """The proximity of the next step; when the search is over, that of its answer."""
        if self._taken == 0:
            proposed = self._search.propose()
            self._proximity = self._search.result().proximity if proposed is None else proposed
        return self._proximity

    def tell(self, reward: float) -> None:
        """What a step earned."""
        self._return += self._discount**self._taken * reward
        self._taken += 1
        if self._taken == self._steps:
            self._land()

    def ended(self) -> None:
        """The machine has ended, e.g. fallen: all later rewards are zero."""
        if self._taken:
            self._land()

    def forget(self) -> None:
        """Forget a trajectory that somebody else has continued or broken off."""
        self._taken, self._return = 0, 0.0

    def _land(self) -> None:
        if self._search.propose() is not None:
            self._search.tell(self._return)
        self.forget()


def usual_size(card: DatasetCard) -> float:
    """In what a margin and a slope count: the size of a log's mean return from an episode's start.

    Trajectories of the autopilot begin there, too.
    """
    return max(abs(card.first_window_return_mean), 1e-6)
