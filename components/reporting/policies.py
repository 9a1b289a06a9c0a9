"""The data behind a report: a row per policy, snapshot and proximity."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import pandas as pd

from components.reporting.evidence import Cell, Evidence

__all__ = ["policy_table"]

_COLUMNS: Final = (
    "dataset",
    "algorithm",
    "seed",
    "updates",
    "proximity",
    "return",
    "logged",
    "pooled",
    "configuration",
    "hardware",
    "commit",
)


def policy_table(evidence: Evidence) -> pd.DataFrame:
    """Mean real return of every evaluated policy.

    Returns:
        `dataset`, `algorithm`, `seed`, `updates` at the snapshot, `proximity` (NaN where the policy
        takes none), `return`, the return `logged` (NaN where that is counted otherwise),
        whether the policy is `pooled`, the digest of its `configuration`, the `hardware` that
        trained it and the `commit` of the code that did (empty if unknown).
    """
    rows = [_rows(cell) for cell in evidence.cells.values()]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame(columns=list(_COLUMNS))


def _rows(cell: Cell) -> pd.DataFrame:
    seeds, snapshots, places = cell.returns.shape
    seed, snapshot, place = (axis.ravel() for axis in np.indices((seeds, snapshots, places)))
    return pd.DataFrame(
        {
            "dataset": cell.dataset,
            "algorithm": cell.algorithm,
            "seed": np.asarray(cell.seeds)[seed],
            "updates": cell.steps[snapshot],
            "proximity": cell.proximities[place],
            "return": cell.returns.ravel(),
            "logged": np.nan if cell.level is None else cell.level,
            "pooled": snapshot >= snapshots - cell.pooled,
            "configuration": _of_seeds(cell.configurations, seed),
            "hardware": _of_seeds(cell.hardware, seed),
            "commit": _of_seeds(cell.commits, seed),
        }
    )


def _of_seeds(known: Sequence[str], seed: npt.NDArray[np.intp]) -> npt.NDArray[np.str_]:
    """What is known of every row's seed."""
    texts = known or [""] * (int(seed.max()) + 1)
    return np.asarray(texts, dtype=np.str_)[seed]
