"""Tables 5.3 and 5.4 with every cell, from the policies of one sweep of all datasets."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.statistics import PoolStatistics, summarise
from components.reporting.tables import thesis_numbers
from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan
from flows.planning.model_choice import model_choice

__all__ = ["TABLES"]

Markdown = Callable[[Sequence[str], Iterable[Sequence[str]]], str]

_POLICIES: Final = Path(__file__).parent / "results" / "nineteen-2026-11" / "policies.parquet"
_ROBOTS: Final = ("swimmer", "hopper", "walker2d")
_NAMES: Final = {
    "bc": "BC", "ddpg": "DDPG", "bcq": "BCQ", "bear": "BEAR", "brac": "BRAC-v", "cql": "CQL",
    "td3_bc": "TD3+BC", "mopo": "MOPO", "morel": "MOReL", "moose": "MOOSE", "wsbc": "WSBC",
    "lion": "LION, best λ",
}  # fmt: skip
_CLOSE: Final = 0.05  # "within 5 %" of the thesis


@cache
def _policies() -> pd.DataFrame:
    return pd.read_parquet(_POLICIES)


@cache
def _cells() -> Mapping[tuple[str, str], tuple[PoolStatistics, float]]:
    """(dataset, algorithm) -> the pool's statistics at the best proximity, and that proximity."""
    policies = _policies()
    pooled = policies[policies["pooled"]]
    found: dict[tuple[str, str], tuple[PoolStatistics, float]] = {}
    groups = pooled.groupby(["dataset", "algorithm", "proximity"], dropna=False)["return"]
    for (dataset, algorithm, proximity), returns in groups:
        statistics = summarise(returns.to_numpy())
        best = found.get((dataset, algorithm))
        if best is None or statistics.tenth_percentile > best[0].tenth_percentile:
            found[dataset, algorithm] = statistics, proximity
    return found


def _table(datasets: Sequence[str], markdown: Markdown) -> str:
    """A row per dataset, and below it the thesis's; the best of ours in bold."""
    cells, thesis = _cells(), thesis_numbers()
    logged = _policies().groupby("dataset")["logged"].first()
    rows = []
    for dataset in datasets:
        own = {name: cells.get((dataset, name)) for name in _NAMES}
        top = max(cell[0].tenth_percentile for cell in own.values() if cell is not None)
        ours, theirs = [dataset, f"{logged[dataset]:.1f}"], ["thesis", ""]
        for name, cell in own.items():
            ours.append("" if cell is None else _shown(*cell, best=cell[0].tenth_percentile == top))
            theirs.append(f"{thesis[dataset, name][0]:g}" if (dataset, name) in thesis else "")
        rows += [ours, theirs]
    return markdown(["dataset", "log, mean", *_NAMES.values()], rows)


def _shown(statistics: PoolStatistics, proximity: float, *, best: bool) -> str:
    value = f"{statistics.tenth_percentile:.1f}"
    at = "" if np.isnan(proximity) else f" at {proximity:g}"
    return (f"**{value}**" if best else value) + f" ({statistics.standard_error:.1f}){at}"


def _turbine(markdown: Markdown) -> str:
    datasets = [name for name in _policies()["dataset"].unique() if name not in _ROBOTS]
    return _table(datasets, markdown)


def _robots(markdown: Markdown) -> str:
    return _table(_ROBOTS, markdown)


def _budgets(markdown: Markdown) -> str:
    """A row per algorithm: updates and seeds here, updates of the thesis, agreement with it."""
    policies, cells, thesis = _policies(), _cells(), thesis_numbers()
    full = _full_updates()
    rows = []
    for name, title in _NAMES.items():
        own = policies[policies["algorithm"] == name]
        seeds = own.groupby("dataset")["seed"].nunique()
        updates = own["updates"].max()
        pairs = [
            (cell[0].tenth_percentile, thesis[dataset, name][0])
            for (dataset, algorithm), cell in cells.items()
            if algorithm == name and (dataset, name) in thesis and dataset not in _ROBOTS
        ]
        agreement = ["", "", ""]
        if pairs and name != "ddpg":
            ours, theirs = np.array(pairs).T
            rank = pd.Series(ours).corr(pd.Series(theirs), method="spearman")
            close = np.abs(ours - theirs) <= _CLOSE * np.abs(theirs)
            low = ours < theirs - _CLOSE * np.abs(theirs)
            agreement = [f"{rank:.2f}", f"{close.sum()} of {len(pairs)}", f"{low.sum()}"]
        turbine, robot = full[name]
        rows.append(
            [title, f"{updates:,}", f"{turbine:,}", f"{robot:,}", str(seeds.min()), *agreement]
        )
    heads = ["", "updates here", "thesis, turbine", "thesis, robots", "seeds", "Spearman"]
    return markdown([*heads, "within 5 %", "lower by more"], rows)


@cache
def _full_updates() -> Mapping[str, tuple[int, int]]:
    """Updates with the thesis's budgets on the turbine and on a robot, by algorithm."""
    chosen = f"algorithms=[{','.join(_NAMES)}]"
    settings = load_settings(["datasets=[bad-0.0,hopper]", chosen, "seeds=[0]"])
    plan = benchmark_plan(settings, model_choice(settings))
    found = {
        (node.tags["algorithm"], node.tags["dataset"]): node.config["settings"]["updates"]
        for node in plan.by_component()["policy_training"]
    }
    return {name: (found[name, "bad-0.0"], found[name, "hopper"]) for name in _NAMES}


TABLES: Final[Mapping[str, Callable[[Markdown], str]]] = {
    "turbine": _turbine,
    "robots": _robots,
    "budgets": _budgets,
}
