"""How far a sweep's results agree with the thesis's: ranks, and cells that differ."""

import math
from collections.abc import Mapping
from typing import Final

import pandas as pd

from components.data.indicators import spearman
from components.reporting.evidence import Evidence
from components.reporting.overview import Column

__all__ = ["agreement_table", "correlation_rows", "domain_of"]

_INDUSTRIAL: Final = "the Industrial Benchmark (table 5.4)"
_ROBOTS: Final = "the robots (table 5.3)"
_UNKNOWN: Final = "not generated yet"
_EVERYTHING: Final = "all"


def domain_of(system: str) -> str:
    """The thesis's table that a system's datasets belong to."""
    if not system:
        return _UNKNOWN
    return _INDUSTRIAL if "IndustrialBenchmark" in system else _ROBOTS


def agreement_table(evidence: Evidence) -> pd.DataFrame:
    """A row per comparable cell: ours and the thesis's 10th percentile and standard errors.

    Cells with another discount in the thesis are left out. `apart` says whether the two differ by
    more than both standard errors together; it cannot be said of a cell without `several` seeds.
    """
    rows = []
    for (dataset, algorithm), thesis in evidence.thesis.items():
        cell = evidence.table.cells.get((dataset, Column(algorithm)))
        if cell is None or thesis.other_discount or cell.value != cell.value:
            continue
        apart = cell.value - thesis.value
        several = math.isfinite(cell.interval[0])  # a single seed has no error that means anything
        rows.append(
            {
                "domain": domain_of(evidence.logs[dataset].system),
                "dataset": dataset,
                "algorithm": algorithm,
                "here": cell.value,
                "standard error": cell.standard_error,
                "thesis": thesis.value,
                "its standard error": thesis.error,
                "difference": apart,
                "apart": several and abs(apart) > cell.standard_error + thesis.error,
                "several": several,
            }
        )
    return pd.DataFrame(rows)


def correlation_rows(table: pd.DataFrame) -> list[Mapping[str, object]]:
    """Spearman's rank correlation of the cells with the thesis's, by domain and over all."""
    if table.empty:
        return []
    domains = [*table.groupby("domain", sort=False), (_EVERYTHING, table)]
    if len(domains) == 2:
        del domains[-1]  # one domain is all
    return [
        {
            "domain": name,
            "cells": len(own),
            "spearman": spearman(own["here"], own["thesis"]),
            "apart": int(own["apart"].sum()) if own["several"].any() else "unknown",
        }
        for name, own in domains
    ]
