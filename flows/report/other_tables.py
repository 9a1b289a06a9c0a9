"""Tables that other doors have written about the same datasets: a ranking, a selection."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from flows.pipeline.sweep_records import known_nodes
from flows.report.shown import RANKINGS

__all__ = ["guesses_of", "judges_of", "ranking_of", "selection_of"]

_FIRST = 3  # policies of a dataset that a report shows
_SELECTION = {
    "dataset": "dataset",
    "sweep": "sweep",
    "algorithm": "algorithm",
    "proximity": "λ",
    "policies": "policies",
    "score": "score",
    "true_return": "true return",
}
"""Columns that are shown, and their headings."""


def ranking_of(root: Path, datasets: Mapping[str, str]) -> pd.DataFrame | None:
    """The ranking that covers most of these datasets; None if there is none.

    Args:
        root: Folder of the store.
        datasets: Name -> key of the node that generated it: a ranking of other logs says nothing.
    """
    best: pd.DataFrame | None = None
    for path in sorted(root.glob(RANKINGS)):
        ranked = known_nodes(root, path.parent.name)
        same = [name for name, key in datasets.items() if key in ranked]
        table = pd.read_csv(path)
        own = table[table["dataset"].isin(same)]
        if len(own) > (0 if best is None else len(best)):
            best = own
    return best


def guesses_of(root: Path, datasets: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """By dataset, the λ that a ranking would try at first, from and to, where there is one.

    Args:
        root: Folder of the store.
        datasets: As :func:`ranking_of` takes them.
    """
    ranking = ranking_of(root, datasets)
    if ranking is None:
        return {}
    columns = (ranking[name] for name in ("dataset", "proximity_from", "proximity_to"))
    return {str(name): (float(low), float(high)) for name, low, high in zip(*columns, strict=True)}


def selection_of(root: Path, sweeps: Sequence[str]) -> pd.DataFrame | None:
    """The first policies of every dataset by their judges; None if none was judged."""
    table = _table(root, sweeps, "selection.csv")
    if table is None:
        return None
    first = table.groupby("dataset", sort=False).head(_FIRST)
    return first[[name for name in _SELECTION if name in first]].rename(columns=_SELECTION)


def judges_of(root: Path, sweeps: Sequence[str]) -> pd.DataFrame | None:
    """How well every score ranked, mean over the datasets; None where no true return is known."""
    table = _table(root, sweeps, "judges.csv")
    if table is None:
        return None
    return table.groupby("score", sort=False).mean(numeric_only=True).reset_index()


def _table(root: Path, sweeps: Sequence[str], name: str) -> pd.DataFrame | None:
    """A table from the reports of all sweeps that have one, below each other."""
    paths = {sweep: root / "reports" / sweep / name for sweep in sweeps}
    tables = [pd.read_csv(path).assign(sweep=s) for s, path in paths.items() if path.is_file()]
    if not tables:
        return None
    table = pd.concat(tables, ignore_index=True)
    return table if len(sweeps) > 1 else table.drop(columns="sweep")
