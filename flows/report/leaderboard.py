"""The leaderboard: a row per dataset, algorithm and seed, from what its evaluation has stored.

A row's tenth percentile is that of the seed's own pool. The table of a sweep pools all seeds, as
the thesis does, so its numbers are no means of the rows'.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from components.aggregation.statistics import (
    PoolStatistics,
    pool_policies,
    pooled_snapshots,
    summarise,
)
from components.core.arrays import load_arrays
from components.core.integrity import DamagedFileError, load_json
from components.core.sealed import check_folder, content_digest, read_record
from components.data.card import DatasetCard
from flows.pipeline.plan import Node, Plan, digest
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.board import Entry, Metrics, Row, View
from flows.report.comparison import comparable_behaviour
from flows.report.views import benchmark_views

__all__ = ["Leaderboard"]

_RETURNS, _DATASETS = "returns.npz", "datasets.json"
_VERSION = 1  # of what a row says; another one writes all rows anew


class Leaderboard:
    """Says the rows of a plan's evaluations."""

    def __init__(self, plan: Plan, store: ArtifactStore) -> None:
        """Takes the plan, and the store in which its artifacts lie."""
        self._plan, self._store = plan, store

    def entry(self, node: Node, folder: Path) -> Entry | None:
        """The row of an evaluation that enters a table; None for any other node.

        Raises:
            DamagedFileError: `node.json` is damaged.
        """
        table = self._table(node)
        if table is None:
            return None
        pool = {"node": node.key, "pool_fraction": table.config["pool_fraction"]}
        return Entry(
            about=digest({**pool, "algorithm": table.config["algorithm"], "version": _VERSION}),
            content=content_digest(read_record(folder)) or node.key,
            row=lambda: self._row(node, table, folder),
        )

    def views(self) -> list[View]:
        """Looks at the rows, and at the runs behind them."""
        tables = self._plan.by_component().get("aggregation", [])
        return benchmark_views(tables)

    def _table(self, node: Node) -> Node | None:
        if node.component != "evaluation":
            return None
        readers = self._plan.dependents(node.key)
        return next((reader for reader in readers if reader.component == "aggregation"), None)

    def _row(self, node: Node, table: Node, folder: Path) -> Row:
        check_folder(folder, (_RETURNS, _DATASETS))
        stored = load_arrays(folder / _RETURNS)
        returns = stored["returns"]  # [S, P, trajectories]
        last = pooled_snapshots(len(returns), table.config["pool_fraction"])
        pool = pool_policies([returns], last)  # [last, P]
        points = [summarise(column) for column in pool.T]
        best = _best(points)
        policy = node.inputs["policy"]
        label, dataset, seed = table.config["algorithm"], node.tags["dataset"], node.tags["seed"]
        level = self._level(policy.inputs["dataset"], table)
        grid = stored["lambdas"]  # [P], under the name in stored files
        distances = stored["distances"][-last:].mean(axis=0)  # [P]
        takes_proximity = not np.isnan(grid[0])
        metrics = _numbers(points[best], pool[:, best], float(distances[best]), level)
        if takes_proximity:
            metrics = {**metrics, **_over_proximity(grid, points, distances, best)}
        who = {"dataset": dataset, "algorithm": label, "seed": seed}
        tags = who | {"takes_proximity": "yes" if takes_proximity else "no"}
        if stored["ended_at"].size:
            tags["ended_at"] = str(int(stored["ended_at"][0]))  # updates, when losses were infinite
        models = {role: source for role, source in policy.inputs.items() if role != "dataset"}
        return Row(
            name=f"{dataset}/{label}/seed{seed}",
            params=who | _budgets(node),
            metrics=metrics,
            note=_note(label, dataset, seed, returns, last, level)
            + (_proximity_note(float(grid[best]), len(grid)) if takes_proximity else ""),
            datasets=load_json(folder / _DATASETS) if (folder / _DATASETS).exists() else [],
            nodes={
                "policy": policy,
                "data": policy.inputs["dataset"],
                **models,
                "evaluation": node,
            },
            model="policy",
            tags=tags,
        )

    def _level(self, data: Node, table: Node) -> float | None:
        """Mean return of the logged behaviour, if it is over as many steps, discounted alike."""
        while "dataset" in data.inputs:  # a part of a log: behaviour is that of the whole
            data = data.inputs["dataset"]
        card_file = "dataset/card.json"
        try:
            self._store.check(data.key, (card_file,))
        except (DamagedFileError, FileNotFoundError):
            return None  # it was removed, or is made again: named by those who need it
        card = DatasetCard.load(self._store.path(data.key) / card_file)
        return comparable_behaviour(card, [table])


def _best(points: list[PoolStatistics]) -> int:
    """The proximity of the highest tenth percentile; the first if none is finite."""
    values = np.array([point.tenth_percentile for point in points])
    return int(np.nanargmax(values)) if np.isfinite(values).any() else 0


def _numbers(
    point: PoolStatistics,
    pool: npt.NDArray[np.float64],
    distance: float,
    level: float | None,
) -> Metrics:
    numbers = {
        "return/tenth_percentile": point.tenth_percentile,
        "return/mean": point.mean,
        "return/best": float(pool.max()),
        "distance": distance,
    }
    if level is not None:
        numbers["return/behaviour"] = level
        numbers["gain_over_behaviour"] = point.tenth_percentile - level
    return {name: [(0, value)] for name, value in numbers.items()}


def _over_proximity(
    grid: npt.NDArray[np.float64],
    points: list[PoolStatistics],
    distances: npt.NDArray[np.float64],
    best: int,
) -> Metrics:
    """Curves whose step is 100 times the proximity, and what the operator starts and ends with."""
    steps = [round(100 * value) for value in grid]
    tenth = [point.tenth_percentile for point in points]
    return {
        "proximity/best": [(0, float(grid[best]))],
        "proximity/return_at_0": [(0, tenth[0])],
        "proximity/return_at_1": [(0, tenth[-1])],
        "over_proximity/tenth_percentile": list(zip(steps, tenth, strict=True)),
        "over_proximity/mean": [(s, p.mean) for s, p in zip(steps, points, strict=True)],
        "over_proximity/distance": [(s, float(d)) for s, d in zip(steps, distances, strict=True)],
    }


def _budgets(evaluation: Node) -> dict[str, str]:
    training, protocol = evaluation.inputs["policy"].config, evaluation.config["evaluation"]
    budgets = {"snapshots": training["snapshots"]}
    budgets |= {n: training["settings"][n] for n in ("updates",) if n in training["settings"]}
    budgets |= {name: protocol[name] for name in ("trajectories", "horizon", "discount")}
    return {name: str(value) for name, value in budgets.items()}


def _note(
    label: str,
    dataset: str,
    seed: str,
    returns: npt.NDArray[np.float64],
    last: int,
    level: float | None,
) -> str:
    policies = "policy" if last == 1 else f"{last} policies"
    text = (
        f"**{label}** on **{dataset}**, seed {seed}: the last {policies} of the {len(returns)} "
        f"that its training handed out, each by its mean over {returns.shape[-1]} trajectories "
        "in the real system. The tenth percentile is that of this seed's own policies; the table "
        "of a sweep, and the thesis, pool those of all seeds."
    )
    if level is None:
        return f"{text} The logged returns are of other steps: there is no gain over them."
    return f"{text} The gain is over the mean return of the logged behaviour, {level:.4g}."


def _proximity_note(best: float, points: int) -> str:
    return (
        f" The policy takes a proximity λ: the numbers are those at its best one of {points}, "
        f"{best:g}, read off and not tuned; `over_proximity/` holds all, with the step 100 λ."
    )
