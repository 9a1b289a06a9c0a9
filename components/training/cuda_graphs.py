"""CUDA graphs of updates: one call replays the thousands of kernels of several updates.

With small networks a GPU runs kernels faster than the host launches them. A graph holds all kernels
of a run of updates, of their draws and of the sums of their metrics, and replaying it costs the
host microseconds. Only the contents of memory may change from one replay to the next: parameters,
optimiser states, and what was staged: the number of the first step, learning rates. Everything
else, such as which networks a step trains, is fixed when the graph is captured. Steps that differ
in it belong to different branches, and every sequence of branches has its own graph. The same
kernels run in the same order, so results do not change.

An update that cannot be captured, because it waits for the host, runs as an ordinary update, and
:func:`lost_graphs` tells of it: it may take ten times as long.
"""

import gc
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import Protocol

import torch
from torch import Tensor

from components.training.loop import Learner
from components.training.sums import MetricSums

__all__ = [
    "BranchingLearner",
    "CudaGraphs",
    "GraphBackend",
    "GraphedLearner",
    "graphed",
    "lost_graphs",
]

WARM_UP = 3  # ordinary updates of a branch first: optimisers and libraries allocate lazily

_LOST: ContextVar[list[str] | None] = ContextVar("lost graphs", default=None)


class BranchingLearner(Learner, Protocol):
    """A learner that names the branch of each of its updates."""

    @property
    def updates_per_graph(self) -> int:
        """Updates that one graph holds: their draws are in memory at once."""

    def branch(self, step: int) -> Hashable | None:
        """Branch of a step; steps of a branch differ in what is staged alone. None: no graph."""

    def stage(self, first: int, count: int) -> None:
        """Tell the graph which steps come next: their number, their learning rates."""

    def draw(self, first: int, count: int) -> None:
        """Draw the random numbers of the steps that were staged, in a graph or outside."""


class GraphBackend(Protocol):
    """Records what runs on a device and runs it again."""

    def region(self) -> AbstractContextManager[None]:
        """Where all updates run, whether recorded or not."""

    def capture(self, run: Callable[[], None]) -> Callable[[], None]:
        """What ``run`` does on the device, as a function; calling it is left to the caller.

        Raises:
            RuntimeError: It cannot be recorded.
        """


class CudaGraphs:
    """Graphs of a GPU.

    Args:
        device: The GPU.
    """

    def __init__(self, device: torch.device) -> None:
        # Capturing needs a stream of its own. Autograd keeps to the stream on which parameters were
        # first used, so ordinary updates run on it, too.
        self._stream = torch.cuda.Stream(device)

    @contextmanager
    def region(self) -> Iterator[None]:
        """The stream of all updates."""
        outside = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(outside)
        with torch.cuda.stream(self._stream):
            yield
        outside.wait_stream(self._stream)

    def capture(self, run: Callable[[], None]) -> Callable[[], None]:
        """A graph of ``run``; a failed capture is tried once more.

        Known from PyTorch's own reports, not measured here: to destroy a graph invalidates a
        capture that is under way, with "operation failed due to a previous error during capture".
        Graphs of a former training lie in reference cycles, so Python's garbage collector destroys
        them at any later allocation, most likely within the longest capture; and from 2.9 on
        PyTorch does not collect before it captures. Hence garbage is collected before and not
        during a capture. Precautions without a known case: other threads cannot invalidate the
        capture, and the second attempt begins when the device is idle.

        Raises:
            RuntimeError: Both attempts failed.
        """
        try:
            return self._capture(run)
        except RuntimeError:
            torch.cuda.synchronize(self._stream.device)
            return self._capture(run)

    def _capture(self, run: Callable[[], None]) -> Callable[[], None]:
        graph = torch.cuda.CUDAGraph()
        with (
            _without_garbage(),
            torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"),
        ):
            run()
        return graph.replay


@contextmanager
def _without_garbage() -> Iterator[None]:
    """Collect garbage now, and none within the block."""
    collects = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class GraphedLearner:
    """A stack of learners whose updates are captured, run by run, then replayed.

    Args:
        learner: Freshly initialised.
        backend: Captures and replays.
    """

    def __init__(self, learner: BranchingLearner, backend: GraphBackend) -> None:
        self._learner, self._backend = learner, backend
        self._several = learner.updates_per_graph
        self._ordinary: set[Hashable] = {None}
        self._warm: Counter[Hashable] = Counter()
        self._graphs: dict[Hashable, tuple[Callable[[], None], _Run]] = {}

    @property
    def lanes(self) -> int:
        """Number of lanes L."""
        return self._learner.lanes

    @property
    def captured(self) -> int:
        """Number of graphs."""
        return len(self._graphs)

    def update(self, step: int) -> dict[str, Tensor]:
        """Update number ``step``; metrics hold until the next one."""
        with self._backend.region():
            return self._advance(step, 1, None)

    def run_updates(self, first: int, count: int, sums: MetricSums) -> None:
        """Do updates ``first ... first + count - 1`` and add their metrics to ``sums``."""
        with self._backend.region():
            step, end = first, first + count
            while step < end:
                together = self._together(step, count, end)
                self._advance(step, together, sums)
                step += together

    def _together(self, step: int, count: int, end: int) -> int:
        """Updates of the next graph of a run of ``count``, which is cut into equal graphs.

        Runs are mostly of one length, and then one graph does for all of them.
        """
        largest = max(n for n in range(1, self._several + 1) if count % n == 0)
        if step + largest > end:  # some have gone one by one
            return 1
        branches = {self._learner.branch(step + i) for i in range(largest)}
        return 1 if branches & self._ordinary else largest

    def _advance(self, first: int, count: int, sums: MetricSums | None) -> dict[str, Tensor]:
        """Do some updates by one graph, where there is one; the last one's metrics."""
        run = _Run(self._learner, first, count, sums)
        branches = [self._learner.branch(first + i) for i in range(count)]
        if branches[0] in self._ordinary:
            return run.counted(by=run.updates)
        self._learner.stage(first, count)
        name = (*branches, sums)
        if name not in self._graphs:
            # The sums of a branch's metrics have their place in memory once it has run.
            if any(self._warm[branch, sums] < WARM_UP for branch in branches):
                self._warm.update((branch, sums) for branch in branches)
                return run.counted(by=run)
            try:
                self._graphs[name] = self._backend.capture(run), run
            except RuntimeError as error:
                self._lose(branches, error)
                return run.counted(by=run)  # draws and rates, too: captured ones did not happen
        replay, captured = self._graphs[name]
        return captured.counted(by=replay)

    def _lose(self, branches: list[Hashable], error: BaseException) -> None:
        """Go on without a graph: of several updates, or of a branch at all."""
        if len(branches) > 1:
            self._several = 1
        else:
            self._ordinary.update(branches)
        while isinstance(error.__context__, RuntimeError):  # what ended the capture, not its end
            error = error.__context__
        reason = " ".join(str(error).split("\n")[0].split()).rstrip(".")
        of = f"{len(branches)} updates at once" if len(branches) > 1 else "updates"
        warnings.warn(
            f"No CUDA graph for {of} of {type(self._learner).__module__}: {reason}", stacklevel=2
        )
        if (lost := _LOST.get()) is not None:
            lost.append(f"{of}: {reason}")

    def state_dict(self) -> dict[str, Tensor]:
        """The learner's state."""
        return self._learner.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned; before the first update, not after it."""
        self._learner.load_state_dict(state)


class _Run:
    """Some updates in a row, as a graph records them: draws, updates, sums.

    What they do on the device is a function without arguments. Their metrics lie where they lay
    when the function was recorded, and which of them there are does not change.
    """

    def __init__(
        self, learner: BranchingLearner, first: int, count: int, sums: MetricSums | None
    ) -> None:
        self._learner, self._first, self._count, self._sums = learner, first, count, sums
        self._metrics: dict[str, Tensor] = {}
        self._reported: Counter[str] = Counter()

    def __call__(self) -> None:
        self._learner.draw(self._first, self._count)
        self.updates()

    def updates(self) -> None:
        """The updates alone, whose draws are made as they are needed."""
        self._reported.clear()
        for step in range(self._first, self._first + self._count):
            self._metrics = self._learner.update(step)
            self._reported.update(self._metrics.keys())
            if self._sums is not None:
                self._sums.accumulate(self._metrics)

    def counted(self, by: Callable[[], None]) -> dict[str, Tensor]:
        """Have them done and count their metrics; those of the last one."""
        by()
        if self._sums is not None:
            self._sums.count(self._reported)
        return self._metrics


@contextmanager
def lost_graphs() -> Iterator[list[str]]:
    """Collect why updates within the block have no graph, though they should: a clause each."""
    lost: list[str] = []
    token = _LOST.set(lost)
    try:
        yield lost
    finally:
        _LOST.reset(token)


def graphed(learner: BranchingLearner, device: torch.device) -> Learner:
    """The learner itself, or its updates as graphs where ``device`` is a GPU."""
    return GraphedLearner(learner, CudaGraphs(device)) if device.type == "cuda" else learner
