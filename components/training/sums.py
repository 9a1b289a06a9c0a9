"""Sums of metrics over an interval of updates."""

from collections import Counter
from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["MetricSums"]


class MetricSums:
    """Sums of the metrics of L lanes and how many updates have reported each.

    The sums stay in the same memory, where a CUDA graph of updates adds to them, with one kernel
    for all metrics of an update. Its additions and their number are therefore told apart:
    replaying a graph adds without a call of :meth:`accumulate`.
    """

    def __init__(self) -> None:
        self._totals: dict[str, Tensor] = {}
        self._counts: Counter[str] = Counter()

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Add the metrics ``[L]`` of one update."""
        self.accumulate(metrics)
        self._counts.update(metrics.keys())

    @torch.no_grad()
    def accumulate(self, metrics: Mapping[str, Tensor]) -> None:
        """Add metrics to the sums, without counting them."""
        for name, value in metrics.items():
            if name not in self._totals:
                self._totals[name] = torch.zeros_like(value)
        if metrics:
            torch._foreach_add_([self._totals[name] for name in metrics], list(metrics.values()))

    def count(self, reported: Counter[str]) -> None:
        """Count metrics that have been added: how many updates reported each."""
        self._counts.update(reported)

    def means(self) -> dict[str, Tensor]:
        """Means ``[L]`` of the metrics reported since :meth:`clear`, over those updates."""
        return {
            name: total / self._counts[name]
            for name, total in self._totals.items()
            if self._counts[name]
        }

    def clear(self) -> None:
        """Begin a new interval."""
        for total in self._totals.values():
            total.zero_()
        self._counts.clear()
