"""Tables that other doors have written about the same datasets: a ranking, a selection."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from flows.pipeline.sweep_records import known_nodes

__all__ = ["ranking_of", "selection_of"]


def ranking_of(root: Path, datasets: Mapping[str, str]) -> pd.DataFrame | None:
    """The ranking that covers most of these datasets; None if there is none.

    Args:
        root: Folder of the store.
        datasets: Name -> key of the node that generated it: a ranking of other logs says nothing.
    """
    best: pd.DataFrame | None = None
    for path in sorted((root / "reports").glob("*/ranking.csv")):
        ranked = known_nodes(root, path.parent.name)
        same = [name for name, key in datasets.items() if key in ranked]
        table = pd.read_csv(path)
        own = table[table["dataset"].isin(same)]
        if len(own) > (0 if best is None else len(best)):
            best = own
    return best


def selection_of(root: Path, sweeps: Sequence[str]) -> pd.DataFrame | None:
    """What policy selection has found, `reports/SWEEP/selection.csv`; None if it was not run."""
    found = {name: root / "reports" / name / "selection.csv" for name in sweeps}
    tables = {name: pd.read_csv(path) for name, path in found.items() if path.is_file()}
    if not tables:
        return None
    if len(sweeps) == 1:
        return next(iter(tables.values()))
    return pd.concat([table.assign(sweep=name) for name, table in tables.items()])
