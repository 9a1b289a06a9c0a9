"""CUDA graphs of updates: one call replays the thousands of kernels of an update.

With small networks a GPU runs kernels faster than the host launches them. A graph holds all kernels
of an update, and replaying it costs the host microseconds. Only the contents of memory may change
from one replay to the next: parameters, optimiser states, and drawn numbers, which are copied to
where the graph reads them. Everything else, such as which networks a step trains, is fixed when the
graph is captured. Steps that differ in it belong to different branches, and every branch has its
own graph. The same kernels run in the same order, so results do not change.

An update that cannot be captured, because it waits for the host, runs as an ordinary update.
"""

import warnings
from collections import Counter
from collections.abc import Hashable
from typing import Protocol

import torch
from torch import Tensor

from components.training.loop import Learner

__all__ = ["BranchingLearner", "GraphedLearner", "graphed"]

WARM_UP = 3  # ordinary updates of a branch first: optimisers and libraries allocate lazily


class BranchingLearner(Learner, Protocol):
    """A learner that names the branch of each of its updates."""

    def branch(self, step: int) -> Hashable | None:
        """Branch of a step; steps of a branch differ in what is staged alone. None: no graph."""

    def stage(self, step: int) -> None:
        """Copy the step's draws and learning rate to where the graph reads them."""


class GraphedLearner:
    """A stack of learners on a GPU whose updates are captured once per branch, then replayed.

    Args:
        learner: Freshly initialised.
        device: Its GPU.
    """

    def __init__(self, learner: BranchingLearner, device: torch.device) -> None:
        self._learner = learner
        # Capturing needs a stream of its own. Autograd keeps to the stream on which parameters were
        # first used, so ordinary updates run on it, too.
        self._stream = torch.cuda.Stream(device)
        self._seen: Counter[Hashable] = Counter()
        self._graphs: dict[Hashable, tuple[torch.cuda.CUDAGraph, dict[str, Tensor]]] = {}
        self._ordinary: set[Hashable] = {None}

    @property
    def lanes(self) -> int:
        """Number of lanes L."""
        return self._learner.lanes

    @property
    def captured(self) -> int:
        """Number of branches whose graph has been captured."""
        return len(self._graphs)

    def update(self, step: int) -> dict[str, Tensor]:
        """Update number ``step``; metrics hold until the next one."""
        outside = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(outside)
        with torch.cuda.stream(self._stream):
            branch = self._learner.branch(step)
            if branch in self._ordinary:
                metrics = self._learner.update(step)
            else:
                metrics = self._capture_or_replay(branch, step)
        outside.wait_stream(self._stream)
        return metrics

    def _capture_or_replay(self, branch: Hashable, step: int) -> dict[str, Tensor]:
        self._learner.stage(step)
        if branch not in self._graphs:
            self._seen[branch] += 1
            if self._seen[branch] <= WARM_UP:
                return self._learner.update(step)
            graph = torch.cuda.CUDAGraph()
            try:
                with torch.cuda.graph(graph, stream=self._stream):
                    metrics = self._learner.update(step)  # records the kernels, does not run them
            except RuntimeError as error:
                self._ordinary.add(branch)
                name = type(self._learner).__module__
                warnings.warn(f"No CUDA graph for updates of {name}: {error}", stacklevel=2)
                return self._learner.update(step)
            self._graphs[branch] = graph, metrics
        graph, metrics = self._graphs[branch]
        graph.replay()
        return metrics

    def state_dict(self) -> dict[str, Tensor]:
        """The learner's state."""
        return self._learner.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned; before the first update, not after it."""
        self._learner.load_state_dict(state)


def graphed(learner: BranchingLearner, device: torch.device) -> Learner:
    """The learner itself, or its updates as graphs where ``device`` is a GPU."""
    return GraphedLearner(learner, device) if device.type == "cuda" else learner
