"""Graphs without a GPU: the operations of an update, recorded once and done again.

The plain twin of :class:`~components.training.cuda_graphs.CudaGraphs`, for tests and checks. Like a
CUDA graph it sees no Python when it replays: the same operations read and write the same tensors,
so that a number which was not staged in memory stays what it was when it was recorded. Like a CUDA
graph it refuses operations that wait for the device, or bring numbers from the host. Recording does
nothing: what was written meanwhile is restored. It is slower than ordinary updates and keeps all
that they compute.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

__all__ = ["RecordedGraphs"]

_Operation = tuple[Any, tuple[Any, ...], dict[str, Any], list[Tensor]]
"""What is called, with what, and where its results lie."""

_WAITS = {  # by name, without overload
    "aten::_local_scalar_dense": "reads a number on the host",
    "aten::nonzero": "needs the number of entries on the host",
    "aten::masked_select": "needs the number of entries on the host",
    "aten::_unique2": "needs the number of entries on the host",
    "aten::equal": "compares on the host",
    "aten::is_nonzero": "decides on the host",
}


class RecordedGraphs:
    """Records operations on the CPU."""

    @contextmanager
    def region(self) -> Iterator[None]:
        """Nothing special."""
        yield

    def capture(self, run: Callable[[], None]) -> Callable[[], None]:
        """The operations of ``run``.

        Raises:
            RuntimeError: One of them could not be part of a CUDA graph.
        """
        recorder = _Recorder()
        try:
            with recorder:
                run()
        finally:
            recorder.restore()
        return partial(_replay, recorder.operations)


class _Recorder(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.operations: list[_Operation] = []
        self._written: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        name = func._schema.name
        if name in _WAITS:
            raise RuntimeError(f"{name} {_WAITS[name]}")
        if name == "aten::lift_fresh" and args[0].ndim:  # a number alone may be one of PyTorch's
            raise RuntimeError(f"{name} brings numbers from the host")
        if name.startswith("aten::index") and any(
            isinstance(a, Tensor) and a.dtype in (torch.bool, torch.uint8)
            for a in tree_flatten(args[1])[0]
        ):
            raise RuntimeError(f"{name} by a mask needs the number of entries on the host")
        self._keep_what_is_written(func, args, kwargs or {})
        made = func(*args, **(kwargs or {}))
        given = tree_map_only(Tensor, Tensor.detach, (tuple(args), dict(kwargs or {})))
        results = [t.detach() for t in tree_flatten(made)[0] if isinstance(t, Tensor)]
        self.operations.append((func, *given, results))
        return made

    def _keep_what_is_written(
        self, func: Any, args: Sequence[Any], kwargs: Mapping[str, Any]
    ) -> None:
        for place, argument in enumerate(func._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                written = args[place] if place < len(args) else kwargs.get(argument.name)
                for tensor in tree_flatten(written)[0]:
                    storage = tensor.untyped_storage()
                    if storage.data_ptr() not in self._written:
                        self._written[storage.data_ptr()] = storage, storage.clone()

    def restore(self) -> None:
        """Undo all writing."""
        for storage, before in self._written.values():
            storage.copy_(before)
        self._written.clear()


@torch.no_grad()
def _replay(operations: Sequence[_Operation]) -> None:
    for func, args, kwargs, results in operations:
        made = [t for t in tree_flatten(func(*args, **kwargs))[0] if isinstance(t, Tensor)]
        for now, then in zip(made, results, strict=True):
            if now.data_ptr() != then.data_ptr():  # neither a view nor written in place
                then.copy_(now)
