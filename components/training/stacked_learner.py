"""The base of learners whose state is named networks and optimisers."""

from collections.abc import Hashable, Mapping

import torch
from torch import Tensor, nn

from components.core.random_streams import LaneStreams
from components.training.state import (
    load_optimizer_state,
    module_state,
    optimizer_state,
    prefixed,
    with_prefix,
)

__all__ = ["StackedLearner"]


class StackedLearner:
    """Base of all learners: named networks and optimisers, saved and restored as one state.

    Subclasses fill the two mappings; targets and learned scalars are networks too. A subclass that
    needs updates before its budget gives their number in ``pretraining``; one whose update is short
    raises ``updates_per_graph``, so that graphs draw numbers for many updates at once, and one
    whose update is long by itself, or draws many numbers, lowers it.
    """

    pretraining: int = 0
    updates_per_graph: int = 20
    _networks: Mapping[str, nn.Module]
    _optimizers: Mapping[str, torch.optim.Optimizer]
    _streams: LaneStreams

    def stage(self, first: int, count: int) -> None:
        """Tell CUDA graphs which steps come next."""
        self._streams.stage(first, count)

    def draw(self, first: int, count: int) -> None:
        """Draw the numbers of the steps that were staged."""
        self._streams.draw(count)

    def branch(self, step: int) -> Hashable | None:
        """Branch of a step; steps of a branch differ in their draws alone. None: no graph.

        On a GPU every branch becomes a graph, see :mod:`components.training.cuda_graphs`. Learners
        whose update depends on the step number itself override this.
        """
        return "all"

    def state_dict(self) -> dict[str, Tensor]:
        """All networks and optimisers, lane axis first in every tensor."""
        state = module_state(self._networks)
        for name, optimizer in self._optimizers.items():
            state |= prefixed(f"{name}_optimizer", optimizer_state(optimizer))
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, network in self._networks.items():
            network.load_state_dict(with_prefix(name, state))
        for name, optimizer in self._optimizers.items():
            load_optimizer_state(optimizer, with_prefix(f"{name}_optimizer", state))
