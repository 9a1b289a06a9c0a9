"""What a report is made of: the stored numbers of one sweep, or of several beside each other.

Of several sweeps every algorithm has the sweep's name behind its own, so that all tables and
figures show them side by side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from components.aggregation.across import Estimate, Ranks
from components.reporting.judged import JudgedLog, algorithms_of
from components.reporting.overview import Column, Overview
from components.reporting.thesis_numbers import Thesis

__all__ = ["Across", "Cell", "Evidence", "Gap", "Log"]


@dataclass(frozen=True)
class Log:
    """What is known of a dataset.

    Attributes:
        name: Its name.
        system: Gymnasium id of the system; empty if it has none.
        level: Mean return of its behaviour, if that is counted as the policies' returns are.
        best: Return of its best episode, likewise.
        about: Where it comes from, in words.
    """

    name: str
    system: str
    level: float | None
    best: float | None
    about: str


@dataclass(frozen=True)
class Cell:
    """A (dataset, algorithm) pair.

    Attributes:
        dataset: Name.
        algorithm: Label, unique within the report.
        base: The algorithm behind the label.
        seeds: ``[R]`` of the policies.
        steps: ``[S]`` updates at the snapshots.
        proximities: ``[P]``, a single NaN for policies that take none.
        returns: ``[R, S, P]`` mean over real trajectories.
        pooled: Last snapshots of every seed that are pooled.
        points: The stored statistics of every proximity.
        level: Mean return of the logged behaviour; None if it is counted otherwise.
        configurations: ``[R]`` digests of all that decides a seed's training: the keys of its runs.
        hardware: ``[R]`` what trained them.
        commits: ``[R]`` of the code that trained them.
    """

    dataset: str
    algorithm: str
    base: str
    seeds: Sequence[int]
    steps: npt.NDArray[np.int64]
    proximities: npt.NDArray[np.float64]
    returns: npt.NDArray[np.float64]
    pooled: int
    points: Sequence[Mapping[str, Any]]
    level: float | None = None
    configurations: Sequence[str] = ()
    hardware: Sequence[str] = ()
    commits: Sequence[str] = ()

    @property
    def adapts(self) -> bool:
        """Whether its policies take a proximity."""
        return len(self.proximities) > 1 or not np.isnan(self.proximities[0])

    def scores(self, place: int) -> npt.NDArray[np.float64]:
        """``[R]`` mean return of every seed's pooled snapshots at one of the proximities."""
        means: npt.NDArray[np.float64] = self.returns[:, -self.pooled :, place].mean(axis=1)
        return means


@dataclass(frozen=True)
class Gap:
    """A pair that is not finished."""

    dataset: str
    algorithm: str
    why: str


@dataclass(frozen=True)
class Across:
    """Algorithms compared over datasets, see :mod:`components.aggregation.across`.

    Attributes:
        datasets: On which all columns are finished.
        columns: What is compared, ``[A]``.
        middles: Interquartile mean of every column's scores.
        thresholds: ``[K]`` scores.
        profiles: Of every column, the share of runs above each threshold.
        improvements: ``[A][A]`` probability that the row beats the column; None on the diagonal.
        ranks: Over the datasets.
    """

    datasets: Sequence[str]
    columns: Sequence[Column]
    middles: Sequence[Estimate]
    thresholds: npt.NDArray[np.float64]
    profiles: Sequence[Estimate]
    improvements: Sequence[Sequence[Estimate | None]]
    ranks: Ranks


@dataclass(frozen=True)
class Evidence:
    """Everything that a report shows.

    Attributes:
        sweeps: Names, with the command that repeats each.
        logs: Datasets by name.
        cells: By dataset and label.
        gaps: What is not finished.
        table: The overview.
        thesis: The thesis's values of comparable cells.
        notes: Sentences on what the numbers do not show.
        differences: Settings that are not the thesis's, or differ between sweeps.
        costs: A row per algorithm: hours of training and evaluation, memory.
        software: A row per combination of software and device.
        ranking: The table of :mod:`flows.rank_datasets`, if it was run on these datasets.
        selection: The policies that judges would choose from the logs alone, if they were asked.
        judges: How well they ranked the policies, where true returns are known.
        judged: Logs without a real system, whose policies were judged and never tried.
        judged_policies: A row per policy of these, snapshot and proximity; empty without such logs.
        across: Algorithms compared over datasets; None if too little is finished.
        budget: Profile and seeds, for titles.
    """

    sweeps: Mapping[str, str]
    logs: Mapping[str, Log]
    cells: Mapping[tuple[str, str], Cell]
    gaps: Sequence[Gap]
    table: Overview
    thesis: Mapping[tuple[str, str], Thesis] = field(default_factory=dict)
    notes: Sequence[str] = ()
    differences: pd.DataFrame = field(default_factory=pd.DataFrame)
    costs: pd.DataFrame = field(default_factory=pd.DataFrame)
    software: pd.DataFrame = field(default_factory=pd.DataFrame)
    ranking: pd.DataFrame | None = None
    selection: pd.DataFrame | None = None
    judges: pd.DataFrame | None = None
    judged: Sequence[JudgedLog] = ()
    judged_policies: pd.DataFrame = field(default_factory=pd.DataFrame)
    across: Across | None = None
    budget: str = ""

    @property
    def algorithms(self) -> list[str]:
        """Labels in the order of the table."""
        return list(dict.fromkeys(column.algorithm for column in self.table.columns))

    @property
    def labels(self) -> list[str]:
        """Of all algorithms, also of those that were judged alone."""
        return list(dict.fromkeys([*self.algorithms, *algorithms_of(self.judged)]))

    def comparable_on(self, dataset: str) -> list[Cell]:
        """Those of a dataset's finished cells that may be compared with each other."""
        names = {column.algorithm for column in self.table.comparable(dataset)}
        return [cell for cell in self.on(dataset) if cell.algorithm in names]

    def on(self, dataset: str) -> list[Cell]:
        """The finished cells of a dataset, in the order of the table."""
        found = [self.cells.get((dataset, name)) for name in self.algorithms]
        return [cell for cell in found if cell is not None]
