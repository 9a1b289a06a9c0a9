"""The thesis's tables 5.3 and 5.4 with every cell, from the policies of one sweep of all logs."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.statistics import PoolStatistics, summarise
from components.reporting.thesis_numbers import thesis_numbers
from docs.result_tables.shared import DATA, logged, table_of
from flows.configuration.settings import load_settings
from flows.planning.benchmark import benchmark_plan

_ROBOTS: Final = ("swimmer", "hopper", "walker2d")
_NAMES: Final = {
    "bc": "BC",
    "ddpg": "DDPG",
    "bcq": "BCQ",
    "bear": "BEAR",
    "brac": "BRAC-v",
    "cql": "CQL",
    "td3_bc": "TD3+BC",
    "mopo": "MOPO",
    "morel": "MOReL",
    "moose": "MOOSE",
    "wsbc": "WSBC",
    "lion": "LION, best λ",
}
_OTHERWISE: Final = "ddpg"
"""The thesis discounts its returns of the turbine with 0.99: their order alone is comparable."""

_CLOSE: Final = 0.05
"""The share of the thesis's number by which ours may differ to be called close."""


def turbine() -> str:
    """Table 5.4: the sixteen logs of the turbine."""
    return _table(tuple(logged()))


def robots() -> str:
    """Table 5.3: the three robots."""
    return _table(_ROBOTS)


def budgets() -> str:
    """One row per algorithm: updates here and in the thesis, and agreement with it."""
    policies, cells, thesis, full = _policies(), _cells(), thesis_numbers(), _full_updates()
    ours_by, theirs_by = {}, {}
    rows = []
    for name, title in _NAMES.items():
        updates = policies[policies["algorithm"] == name].groupby("dataset")["updates"].max()
        most = [updates.reindex(logs).max() for logs in (list(logged()), list(_ROBOTS))]
        here = ["" if np.isnan(number) else f"{number:,.0f}" for number in most]
        pairs = {
            log: (cells[log, name][0].tenth_percentile, thesis[log, name][0])
            for log in logged()
            if (log, name) in thesis and (log, name) in cells
        }
        agreement = ["", "", ""]
        if pairs:
            ours, theirs = np.array(list(pairs.values())).T
            ours_by |= {(log, name): value for log, (value, _) in pairs.items()}
            theirs_by |= {(log, name): value for log, (_, value) in pairs.items()}
            agreement[0] = _rank(ours, theirs)
        if pairs and name != _OTHERWISE:
            far = (ours - theirs) / np.abs(theirs)
            agreement[1:] = [
                f"{(np.abs(far) <= _CLOSE).sum()} of {len(pairs)}",
                f"{(far < -_CLOSE).sum()}",
            ]
        rows.append([title, *here, *(f"{number:,}" for number in full[name]), *agreement])
    as_printed = ours_by | {(log, _OTHERWISE): value for log, value in _as_printed().items()}
    whole = {
        "all": (ours_by, ()),
        "all but DDPG": (ours_by, (_OTHERWISE,)),
        "all, DDPG discounted with 0.99": (as_printed, ()),
        "the same without MOReL": (as_printed, ("morel",)),
        "without MOReL, CQL and MOPO": (as_printed, ("morel", "cql", "mopo")),
    }
    for title, (found, without) in whole.items():
        kept = [cell for cell in found if cell[1] not in without]
        rank = _rank(*np.array([(found[cell], theirs_by[cell]) for cell in kept]).T)
        rows.append([title, *[""] * 4, rank, "", ""])
    heads = ["", "updates: turbine", "robots", "thesis: turbine", "robots"]
    return table_of([*heads, "Spearman", "within 5 %", "lower by more"], rows)


def ddpg() -> str:
    """One row per log: DDPG with both discounts, beside the thesis's number."""
    cells, thesis, full = _cells(), thesis_numbers(), _as_printed()
    rows = []
    for log in logged():
        value, (theirs, error) = full[log], thesis[log, _OTHERWISE]
        ours = cells[log, _OTHERWISE][0].tenth_percentile
        rows.append([log, f"{ours:.1f}", f"{value:.1f}", f"{theirs:.1f} ({error:g})"])
    return table_of(["dataset", "0.97, 3,000 updates", "0.99, 10,000 updates", "thesis"], rows)


def free_halt() -> str:
    """One row per log: MOReL with the HALT of its paper and with one that costs nothing."""
    table = pd.read_csv(DATA / "morel-halt-2026-11.csv")
    few, many = (own.set_index("dataset") for _, own in table.groupby("updates", sort=True))
    cells, thesis = _cells(), thesis_numbers()
    rows = []
    for log in logged():
        full = f"{many.tenth_percentile[log]:.1f}" if log in many.index else ""
        ends = (few[f"steps_before_halt_{when}"][log] for when in ("first", "last"))
        rows.append(
            [
                log,
                f"{cells[log, 'morel'][0].tenth_percentile:.1f}",
                f"{few.tenth_percentile[log]:.1f}",
                full,
                " to ".join(f"{steps:.0f}" for steps in ends),
                f"{thesis[log, 'morel'][0]:.1f}",
            ]
        )
    heads = ["HALT as in the paper", "HALT pays 0", "500 updates", "steps before HALT", "thesis"]
    return table_of(["dataset", *heads], rows)


@cache
def _as_printed() -> Mapping[str, float]:
    """By log, the 10th percentile of DDPG's pool with the thesis's budget and discount."""
    policies = pd.read_parquet(DATA / "nineteen-2026-11" / "ddpg-discounted-with-0.99.parquet")
    returns = policies[policies["pooled"]].groupby("dataset")["return"]
    return {log: summarise(own.to_numpy()).tenth_percentile for log, own in returns}


def _rank(ours: np.ndarray, theirs: np.ndarray) -> str:
    return f"{pd.Series(ours).corr(pd.Series(theirs), method='spearman'):.2f}"


@cache
def _policies() -> pd.DataFrame:
    return pd.read_parquet(DATA / "nineteen-2026-11" / "policies.parquet")


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


def _table(datasets: Sequence[str]) -> str:
    """A row per dataset, and below it the thesis's; the best of ours in bold."""
    cells, thesis = _cells(), thesis_numbers()
    means = _policies().groupby("dataset")["logged"].first()
    rows = []
    for dataset in datasets:
        own = {name: cells[dataset, name] for name in _NAMES if (dataset, name) in cells}
        top = max(statistics.tenth_percentile for statistics, _ in own.values())
        ours, theirs = [dataset, f"{means[dataset]:.1f}"], ["thesis", ""]
        for name in _NAMES:
            shown = ""
            if name in own:
                statistics, proximity = own[name]
                value = f"{statistics.tenth_percentile:.1f}"
                shown = f"**{value}**" if statistics.tenth_percentile == top else value
                shown += "" if np.isnan(proximity) else f" at {proximity:g}"
            ours.append(shown)
            theirs.append(f"{thesis[dataset, name][0]:g}" if (dataset, name) in thesis else "")
        rows += [ours, theirs]
    return table_of(["dataset", "log, mean", *_NAMES.values()], rows)


@cache
def _full_updates() -> Mapping[str, tuple[int, int]]:
    """Updates with the thesis's budgets on the turbine and on a robot, by algorithm."""
    chosen = f"algorithms=[{','.join(_NAMES)}]"
    settings = load_settings(["datasets=[bad-0.0,hopper]", chosen, "seeds=[0]", "profile=paper"])
    plan = benchmark_plan(settings)
    found = {
        (node.tags["algorithm"], node.tags["dataset"]): node.config["settings"]["updates"]
        for node in plan.by_component()["policy_training"]
    }
    return {name: (found[name, "bad-0.0"], found[name, "hopper"]) for name in _NAMES}
