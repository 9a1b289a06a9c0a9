"""What every algorithm is given, and the little they share."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from components.data.dataset import OfflineDataset
from components.data.lanes import LaneData
from components.models.recurrent_ensemble import RecurrentEnsemble
from components.models.rollout import MachineRule
from components.networks.policy import Policy, PolicyCard
from components.networks.training import Learner

__all__ = ["Ingredients", "PolicyLearner", "first_rows"]


@dataclass(frozen=True)
class Ingredients:
    """Data, random streams and fitted models of L lanes.

    Attributes:
        data: The lanes' datasets on their device.
        keys: One random stream per lane, a digest of (dataset, algorithm, seed).
        behaviour_policies: Clones of the logged behaviour, one per lane, where needed.
        recurrent_ensembles: Transition models, one per lane, where needed.
    """

    data: LaneData
    keys: Sequence[int]
    behaviour_policies: Sequence[Policy] = field(default=())
    recurrent_ensembles: Sequence[RecurrentEnsemble] = field(default=())

    @property
    def machine(self) -> MachineRule:
        """What the datasets' cards say about the machine; equal for all lanes."""
        rules = {MachineRule.of_card(dataset.card) for dataset in self.data.datasets}
        if len(rules) != 1:
            raise ValueError("Lanes of one stack must come from the same kind of machine.")
        return rules.pop()

    @property
    def mean_window_returns(self) -> list[float]:
        """Mean discounted 100-step return of each lane's log, over all window starts."""
        return [dataset.card.all_windows_return_mean for dataset in self.data.datasets]


class PolicyLearner(Learner, Protocol):
    """A stack of learners that can be deployed."""

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""


def first_rows(dataset: OfflineDataset, window: int) -> npt.NDArray[np.int64]:
    """Transitions among the first ``window`` of their episode, ``[<= E * window]``."""
    starts, ends = dataset.episode_starts[:-1], dataset.episode_starts[1:]
    rows = starts[:, None] + np.arange(window)
    return rows[rows < ends[:, None]]
