"""Compares the algorithms of a report over its datasets."""

from collections.abc import Mapping, Sequence

import numpy as np

from components.aggregation.across import (
    Estimate,
    improvement,
    interquartile_mean,
    mean_ranks,
    profile,
    score,
)
from components.data.indicators import RETURN_FLOORS
from components.reporting.evidence import Across, Cell, Log
from components.reporting.overview import Column, Overview

__all__ = ["compare_across"]

_THRESHOLDS = np.linspace(0.0, 1.0, 51)  # of the scores in performance profiles

Cells = Mapping[tuple[str, str], Cell]


def compare_across(table: Overview, cells: Cells, logs: Mapping[str, Log]) -> Across | None:
    """Compare the columns of the overview on the datasets that all of them have.

    Algorithms that are finished on less than half as many datasets as others are left out.

    Returns:
        The comparison; None if fewer than two columns share a dataset.
    """
    columns, datasets = _shared(table)
    if len(columns) < 2 or not datasets:
        return None
    ends = _score_ends(cells, logs)
    runs = [
        [
            score(cells[name, c.algorithm].scores(_place(table, name, c, cells)), *ends[name])
            for name in datasets
        ]
        for c in columns
    ]
    values = np.array([[table.cells[name, c].value for c in columns] for name in datasets])
    return Across(
        datasets,
        columns,
        [interquartile_mean(own) for own in runs],
        _THRESHOLDS,
        [profile(own, _THRESHOLDS) for own in runs],
        _improvements(runs),
        mean_ranks(values),
    )


def _shared(table: Overview) -> tuple[list[Column], list[str]]:
    finished = {
        c: {name for name in table.logged if (name, c) in table.cells} for c in table.columns
    }
    most = max(map(len, finished.values()), default=0)
    columns = [column for column, names in finished.items() if 2 * len(names) >= most]
    shared = [name for name in table.logged if all(name in finished[c] for c in columns)]
    return columns, shared


def _place(table: Overview, dataset: str, column: Column, cells: Cells) -> int:
    """Number of the proximity that a column shows on a dataset."""
    proximities = cells[dataset, column.algorithm].proximities
    if column.point == "best":
        best = table.cells[dataset, column].proximity
        return int(np.argmin(np.abs(proximities - best)))
    return len(proximities) - 1 if column.point == "1" else 0


def _score_ends(cells: Cells, logs: Mapping[str, Log]) -> dict[str, tuple[float, float]]:
    """By dataset, the returns with scores 0 and 1; they are those of its system.

    0 is the return that nothing falls below where it is known and returns are counted so, else the
    least return of a pooled policy; 1 is the best return of a pooled policy or a logged episode.
    """
    ends = {}
    for name, log in logs.items():
        related = [other for other in logs.values() if other.system == log.system]
        names = {other.name for other in related}
        pooled = [
            cell.returns[:, -cell.pooled :]
            for (dataset, _), cell in cells.items()
            if dataset in names
        ]
        returns = np.concatenate([some[np.isfinite(some)] for some in pooled] or [np.zeros(1)])
        logged = [other.best for other in related if other.best is not None]
        best = max([float(returns.max(initial=-np.inf)), *logged])
        floor = float(returns.min(initial=best))
        if logged:
            floor = min(floor, *logged)
            known = RETURN_FLOORS.get(log.system)
            floor = floor if known is None else min(known, floor)
        ends[name] = (floor, best if best > floor else floor + 1.0)
    return ends


def _improvements(runs: Sequence[Sequence[np.ndarray]]) -> list[list[Estimate | None]]:
    """Row beats column; the other half of the table follows from the first."""
    found: list[list[Estimate | None]] = [[None] * len(runs) for _ in runs]
    for one, mine in enumerate(runs):
        for other in range(one):
            share = improvement(mine, runs[other])
            found[one][other] = share
            found[other][one] = Estimate(1 - share.value, 1 - share.high, 1 - share.low)
    return found
