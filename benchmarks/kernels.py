"""Kernels that an update launches, by purpose: ``python -m benchmarks.kernels [LEARNER ...]``.

What a GPU waits for with small networks. Counted are the operations that PyTorch dispatches, views
and allocations aside, as if for a GPU: a stack is never cut into parts for a processor's cache, and
:data:`LAUNCHES` names operations that are more than one kernel there. An operation on a list of
tensors (fused optimiser, targets) counts as one. Random numbers are drawn as on a GPU: their
kernels serve all updates of a graph, and an update counts its share. Counts depend on the number of
layers and on horizons, not on widths or the batch, which is small.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.learner_paths import barely_fitted
from benchmarks.measure import markdown
from benchmarks.model_free import BLOCK
from benchmarks.settings import Settings
from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs, PolicyLearner
from components.core.random_streams import LaneStreams, lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.networks import lane_groups

__all__ = ["KINDS", "LAUNCHES", "kernels", "kernels_of_update", "report"]

LANES = 2  # one lane would hide copies that several need
LAUNCHES: Mapping[str, int] = MappingProxyType(
    {
        "baddbmm": 2,  # the bias is copied to every row first
        "slice_backward": 2,  # zeros, then a copy
        "select_backward": 2,
    }
)
"""Operations that are several kernels on a GPU."""

_BY_KIND = {
    "matrix products": ("bmm", "baddbmm", "mm", "addmm", "dot", "mv"),
    "optimiser": ("_fused_adam_", "_fused_sgd_", "_foreach_add_"),
    "targets": ("_foreach_lerp_",),
    "gather": ("index", "index_select", "gather", "take", "embedding", "index_put_", "scatter"),
    "copies": (
        "_to_copy",
        "cat",
        "clone",
        "copy_",
        "fill_",
        "full",
        "full_like",
        "select_backward",
        "slice_backward",
        "stack",
        "zeros",
        "zeros_like",
        "new_zeros",
    ),
}
_KIND_OF = {name: kind for kind, names in _BY_KIND.items() for name in names}
DRAWS, REST = "draws", "element-wise, sums"
KINDS = (*_BY_KIND, REST, DRAWS)
"""Purposes, in the order of the table."""

_FREE = frozenset(
    {"_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"}
)
_SMALL = MappingProxyType({"batch": 8, "rollouts": 50, "trajectories": 4})  # settings, where any


class _Counting(TorchDispatchMode):
    """Counts kernels by purpose while it is active."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels: Counter[str] = Counter()
        self.names: Counter[str] = Counter()
        self.drawing = False

    def __torch_dispatch__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        name = func.overloadpacket.__name__
        if func.namespace == "aten" and not func.is_view and name not in _FREE:
            kind = DRAWS if self.drawing else _KIND_OF.get(name, REST)
            self.kernels[kind] += LAUNCHES.get(name, 1)
            self.names[name] += LAUNCHES.get(name, 1)
        return func(*args, **(kwargs or {}))


@contextmanager
def _counting() -> Iterator[_Counting]:
    """Count, the streams' own operations as draws."""
    at = LaneStreams.at
    with _Counting() as counted:

        def drawn(streams: LaneStreams, step: int) -> dict[str, torch.Tensor]:
            counted.drawing = True
            try:
                return at(streams, step)
            finally:
                counted.drawing = False

        with mock.patch.object(LaneStreams, "at", drawn):
            yield counted


def kernels(run: Callable[[], object]) -> tuple[Counter[str], Counter[str]]:
    """Kernels of a run, by purpose and by the name of the operation."""
    with _counting() as counted:
        run()
    return counted.kernels, counted.names


def _uncut(module: Any, lanes: int, groups: int) -> list[tuple[slice, Any]]:
    """A stack in one part, whatever is asked for."""
    return lane_groups(module, lanes, min(groups, 1))


def learner_as_on_a_gpu(algorithm: str, dataset: OfflineDataset) -> PolicyLearner:
    """A learner of two lanes whose stacks are not cut, with small batches."""
    record = ALGORITHMS[algorithm]
    settings = record.config()
    few = {f.name: _SMALL[f.name] for f in fields(settings) if f.name in _SMALL}
    models = {name: [barely_fitted(name, dataset)] * LANES for name in record.needs}
    inputs = LearnerInputs(
        data=LaneData([dataset] * LANES, torch.device("cpu"), record.frame_epsilon),
        keys=[lane_key(dataset.card.name, algorithm, seed) for seed in range(LANES)],
        models=models,
    )
    module = record.learner.__module__
    with mock.patch(f"{module}.lane_groups", _uncut, create=True):
        return record.learner(replace(settings, **few), inputs)


def kernels_of_update(
    algorithm: str, dataset: OfflineDataset
) -> tuple[dict[str, float], dict[str, float]]:
    """Mean kernels of two updates in a row, past all warm-ups: by purpose, and by operation."""
    learner = learner_as_on_a_gpu(algorithm, dataset)
    middle = 2 * BLOCK if algorithm == "mopo" else ALGORITHMS[algorithm].config().updates // 2
    first = learner.pretraining + (middle // BLOCK + 1) * BLOCK
    if algorithm == "mopo":
        learner.update(0)  # fills the buffer
    for step in (first, first + 1):
        learner.update(step)  # draws a block, and all optimisers make their moments

    def two() -> None:
        learner.update(first + 2)
        learner.update(first + 3)

    by_kind, by_name = ({name: n / 2 for name, n in each.items()} for each in kernels(two))
    several = learner.updates_per_graph
    learner.stage(first, several)
    drawing, _ = kernels(lambda: learner.draw(first, several))
    by_kind[DRAWS] = by_kind.get(DRAWS, 0) + sum(drawing.values()) / several
    return by_kind, by_name


def report(algorithms: Sequence[str] = tuple(ALGORITHMS), operations: bool = False) -> str:
    """A Markdown table, a row per learner.

    Args:
        algorithms: Names.
        operations: Whether to name the most frequent operations, too.
    """
    dataset = Settings(quick=True).dataset()
    rows = []
    for algorithm in algorithms:
        by_kind, by_name = kernels_of_update(algorithm, dataset)
        row = [algorithm, f"{sum(by_kind.values()):,.0f}"]
        row += [f"{by_kind.get(kind, 0):,.0f}" for kind in KINDS]
        if operations:
            most = sorted(by_name.items(), key=lambda item: -item[1])[:12]
            row.append(", ".join(f"{name} {count:,.0f}" for name, count in most))
        rows.append(row)
    columns = ["learner", "kernels", *KINDS, *(["operations"] if operations else [])]
    return markdown(columns, rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kernels", description=__doc__)
    parser.add_argument("algorithms", nargs="*", metavar="LEARNER", help="all, if none is named")
    parser.add_argument("--operations", action="store_true", help="name the most frequent ones")
    options = parser.parse_args()
    if unknown := sorted(set(options.algorithms) - set(ALGORITHMS)):
        parser.error(
            f"no learner is called {', '.join(unknown)}; there are {', '.join(ALGORITHMS)}"
        )
    print(report(options.algorithms or tuple(ALGORITHMS), options.operations))


if __name__ == "__main__":
    main()
