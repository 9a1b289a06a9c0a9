"""The numbers that the page's figures are drawn from, as plain JSON; what is not finite is null."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from components.aggregation.across import Estimate
from components.reporting.evidence import Across, Cell, Evidence

__all__ = ["colours", "page_data"]

_LION: Final = "#d1373f"
_OTHERS: Final = (
    "#2f6fb3", "#e69f00", "#2a9d6f", "#8a5fbf", "#56b4e9", "#a6761d", "#cc6f9e", "#7a8b00",
    "#17808f", "#9c3d10", "#5566cc", "#6b6b6b", "#b59f00", "#3f9b2f", "#b0508f", "#007a5a",
)  # fmt: skip
_DIGITS: Final = 6  # significant ones: figures need no more, and the page stays small


def colours(algorithms: Sequence[str]) -> dict[str, str]:
    """A colour for every algorithm; LION's is its own."""
    others = [name for name in algorithms if not name.startswith("lion")]
    found = {name: _OTHERS[number % len(_OTHERS)] for number, name in enumerate(others)}
    return {name: found.get(name, _LION) for name in algorithms}


def page_data(evidence: Evidence, agreement: pd.DataFrame) -> dict[str, Any]:
    """Everything that the page's script reads.

    Args:
        evidence: Of the report.
        agreement: Its cells beside the thesis's.
    """
    tints = colours(evidence.labels)
    cells = [cell for dataset in evidence.logs for cell in evidence.comparable_on(dataset)]
    return {
        "budget": evidence.budget,
        "algorithms": [{"name": name, "colour": tints[name]} for name in evidence.labels],
        "logs": [{"name": log.name, "level": plain(log.level)} for log in evidence.logs.values()],
        "cells": [_cell(cell) for cell in cells],
        "thesis": [plain(row) for row in agreement.to_dict("records")],
        "across": None if evidence.across is None else _across(evidence.across),
    }


def plain(value: Any) -> Any:
    """JSON-able copy with rounded numbers, None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value


def _cell(cell: Cell) -> dict[str, Any]:
    several = len(cell.seeds) > 1
    spread = cell.returns.std(axis=0, ddof=1) if several else np.zeros(cell.returns.shape[1:])
    shown = ("lambda", "mean", "seed_std", "distance", "tenth_percentile")
    return {
        "dataset": cell.dataset,
        "algorithm": cell.algorithm,
        "adapts": cell.adapts,
        "level": plain(cell.level),
        "steps": [int(step) for step in cell.steps],
        "proximities": plain(cell.proximities) if cell.adapts else [0.0],
        "mean": plain(cell.returns.mean(axis=0)),
        "sd": plain(spread),
        "points": [plain({name: point[name] for name in shown}) for point in cell.points],
    }


def _across(across: Across) -> dict[str, Any]:
    columns = [
        {"name": column.heading, "algorithm": column.algorithm, "point": column.point}
        for column in across.columns
    ]
    return {
        "columns": columns,
        "middles": [_estimate(middle) for middle in across.middles],
        "thresholds": plain(across.thresholds),
        "profiles": [_estimate(profile) for profile in across.profiles],
        "improvements": [
            [None if share is None else _estimate(share) for share in row]
            for row in across.improvements
        ],
        "ranks": plain({"mean": across.ranks.mean, "critical": across.ranks.critical_difference}),
    }


def _estimate(estimate: Estimate) -> list[Any]:
    """Value and both ends of the interval; None for ends that are not known."""
    value, *ends = (np.asarray(part) for part in (estimate.value, estimate.low, estimate.high))
    known = all(np.isfinite(end).all() for end in ends)
    return [plain(value.tolist()), *(plain(end.tolist()) if known else None for end in ends)]
