"""What studies read of a finished plan, and how they write what they have found."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from components.core.arrays import load_arrays
from components.core.files import write_text
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset
from components.reporting.figures import save_figure
from components.reporting.panels import Line, Panel, panels_figure
from components.reporting.ranking import markdown
from components.reporting.tables import with_undefined
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.report.comparison import comparable_behaviour
from flows.studies.study import Drawn

__all__ = [
    "Cell",
    "cells",
    "decimals",
    "levels",
    "opened",
    "panels",
    "promised",
    "real_returns",
    "written",
]

Array = NDArray[np.float64]

_PROMISE: Final = "policy/virtual_return"

_DECIMALS: Final = {
    **dict.fromkeys(("drops", "tried", "logs", "below without", "below with"), 0),
    **dict.fromkeys(("best λ", "below the log from λ", "distance at 1"), 2),
    **dict.fromkeys(("knob", "at", "thesis knob", "eta", "beta"), 2),
    **dict.fromkeys(("error", "deviation", "clone"), 4),
}
"""Of columns of studies' tables; other numbers are returns, and have one."""


def decimals(table: pd.DataFrame) -> dict[str, int]:
    """By column of numbers, the decimals that are shown."""
    numbers = table.select_dtypes("number").columns
    return {name: _DECIMALS.get(name, 1) for name in numbers}


@dataclass(frozen=True)
class Cell:
    """The finished policies of a dataset and a configuration of an algorithm.

    Attributes:
        dataset: Its name.
        algorithm: Of the algorithm.
        label: Of the configuration, in tables.
        settings: The configuration, as its node has it.
        points: Of the aggregation, in the order of the proximity; one for fixed policies.
        node: The aggregation.
    """

    dataset: str
    algorithm: str
    label: str
    settings: Mapping[str, Any]
    points: Sequence[Mapping[str, Any]]
    node: Node

    def column(self, name: str) -> Array:
        """A statistic of all points; NaN where there is none."""
        return np.array([math.nan if p[name] is None else p[name] for p in self.points])

    @property
    def returns(self) -> Array:
        """Mean return of all points."""
        return self.column("mean")

    @property
    def seeds(self) -> Mapping[str, Node]:
        """The evaluations."""
        return self.node.inputs

    def line(self, name: str, *, decisive: bool = True) -> Line:
        """Its curve over the proximity."""
        return Line(
            name,
            self.column("lambda"),
            self.returns,
            self.column("seed_std"),
            self.column("distance"),
            decisive,
        )


def cells(plan: Plan, store: ArtifactStore, algorithm: str = "") -> list[Cell]:
    """The cells of a finished plan, in its order.

    Args:
        plan: All of it is finished.
        store: With its artifacts.
        algorithm: Whose; empty for all.
    """
    found = []
    for node in plan.by_component().get("aggregation", ()):
        if algorithm and node.tags["algorithm"] != algorithm:
            continue
        summary = with_undefined(store.read_json(node.key, "summary.json"))
        policy = next(iter(node.inputs.values())).inputs["policy"]
        found.append(
            Cell(
                node.tags["dataset"],
                node.tags["algorithm"],
                summary["algorithm"],
                policy.config["settings"],
                summary["points"],
                node,
            )
        )
    return found


def opened(plan: Plan, store: ArtifactStore, dataset: str) -> OfflineDataset:
    """A dataset of a finished plan."""
    [node] = (n for n in plan.by_component()["data_generation"] if n.tags["dataset"] == dataset)
    return OfflineDataset.open(store.path(node.key) / "dataset")


def levels(plan: Plan, store: ArtifactStore) -> dict[str, float]:
    """By dataset the mean return of its log; NaN where it is not counted as the policies' is."""
    nodes = plan.by_component()
    found = {}
    for node in nodes["data_generation"]:
        card = DatasetCard.load(store.path(node.key) / "dataset" / "card.json")
        level = comparable_behaviour(card, nodes.get("aggregation", []))
        found[card.name] = math.nan if level is None else level
    return found


def real_returns(cell: Cell, store: ArtifactStore) -> tuple[Array, Array]:
    """Updates ``[S]`` and mean returns ``[R, S, K]`` of the seeds' snapshots, at K proximities."""
    stored = [load_arrays(store.path(node.key) / "returns.npz") for node in cell.seeds.values()]
    return stored[0]["steps"], np.stack([s["returns"].mean(axis=2) for s in stored])


def promised(cell: Cell, store: ArtifactStore) -> tuple[Array, Array]:
    """Updates ``[T]`` and what the ensemble promised in their course, mean over the seeds."""
    policies = [node.inputs["policy"] for node in cell.seeds.values()]
    curves = [load_arrays(store.path(policy.key) / "curves.npz") for policy in policies]
    values = [curve[f"{_PROMISE}/value"] for curve in curves]
    return curves[0][f"{_PROMISE}/step"], np.mean(values, axis=0)


def panels(lines: Mapping[str, Sequence[Line]], level: Mapping[str, float]) -> list[Panel]:
    """One panel per dataset."""
    return [Panel(dataset, level[dataset], own) for dataset, own in lines.items()]


def written(
    folder: Path,
    name: str,
    table: pd.DataFrame,
    thesis: str,
    figures: Mapping[str, tuple[Sequence[Panel], str, Mapping[str, Any]]],
) -> Drawn:
    """Write the figures and the table of a study.

    Args:
        folder: An existing one.
        name: Of the study; its table is `NAME.csv`, with what is said about it `NAME.md`.
        table: What was found.
        thesis: What the thesis says, as Markdown.
        figures: By name of the file panels, label of their horizontal axes, and further arguments
            of :func:`.panels_figure`.
    """
    files = []
    for figure, (drawn, below, how) in figures.items():
        files.append(folder / f"{figure}.png")
        save_figure(panels_figure(drawn, below, **how), files[-1])
    text = f"{markdown(table, decimals(table))}\n{thesis}"
    for suffix, content in (
        ("csv", table.to_csv(index=False, lineterminator="\n")),
        ("md", text),
    ):
        files.append(folder / f"{name}.{suffix}")
        write_text(files[-1], content)
    return Drawn(files, text)
