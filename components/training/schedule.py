"""Learning rates that depend on the step, also inside a CUDA graph of several updates."""

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["Schedule"]


class Schedule:
    """A learning rate that depends on the step.

    A graph cannot ask for the rate of a step: it repeats what it has captured. Therefore the rates
    of the steps to come are staged in memory, and each update copies its own from there to where
    the optimiser reads it. Where the optimiser keeps its rate as a number there are no graphs, and
    the number is replaced.

    Args:
        optimizer: The optimiser whose rate is set.
        rate: Learning rate of a step, by step number.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, rate: Callable[[int], float]) -> None:
        self._optimizer, self._rate = optimizer, rate
        self._steps = range(0)  # those staged last
        self._staged: dict[int, Tensor] = {}  # by number of steps: graphs of each read their own

    def stage(self, first: int, count: int) -> None:
        """Write the rates of some steps to where :meth:`follow` finds them; not in a graph."""
        self._steps = range(first, first + count)
        places = [g["lr"] for g in self._optimizer.param_groups if isinstance(g["lr"], Tensor)]
        if places:
            rates = torch.tensor([self._rate(step) for step in self._steps], dtype=places[0].dtype)
            if count not in self._staged:
                self._staged[count] = rates.to(places[0].device, copy=True)
            self._staged[count].copy_(rates)

    @torch.no_grad()
    def follow(self, step: int) -> None:
        """Set the rate of a step: in a graph, of one that has been staged."""
        for group in self._optimizer.param_groups:
            if not isinstance(group["lr"], Tensor):
                group["lr"] = self._rate(step)
            elif step in self._steps:
                group["lr"].copy_(self._staged[len(self._steps)][step - self._steps.start])
            else:
                group["lr"].fill_(self._rate(step))
