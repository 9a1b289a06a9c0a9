"""A flat table of results, and prepared looks at runs: what a tracker shows people first.

The pipeline knows that such a table exists; what its rows say is the business of those who plan.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from flows.pipeline.plan import Node

__all__ = ["Board", "Entry", "Metrics", "Row", "View"]

Metrics = Mapping[str, Sequence[tuple[int, float]]]
"""Per name (step, value) pairs; a single number has step 0."""


@dataclass(frozen=True)
class Row:
    """What a row of the table says.

    Attributes:
        name: Short and sortable.
        params: What it is a result of.
        metrics: Per name (step, value) pairs; a single number has step 0.
        note: A few sentences in Markdown.
        datasets: Data sets behind it, each with `name`, `digest` and `source`.
        nodes: The nodes behind it by role.
        model: Role of the node that made what is judged; empty for none.
        tags: What it is found by, besides its parameters.
    """

    name: str
    params: Mapping[str, str]
    metrics: Metrics
    note: str
    datasets: Sequence[Mapping[str, Any]]
    nodes: Mapping[str, Node]
    model: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Entry:
    """A row that is read only if the table lacks it.

    Attributes:
        about: A digest of what the row is about.
        content: A digest of the files that it is read from; other files make another row.
        row: Reads it. Raises DamagedFileError.
    """

    about: str
    content: str
    row: Callable[[], Row]


@dataclass(frozen=True)
class View:
    """A prepared look at runs: which, in what order, with which columns and charts.

    Columns and metrics are named as in MLflow's filters: `params.seed`, `tags.component`.

    Attributes:
        key: Letters, digits, `-`, `_`, `.`; part of an address.
        name: For people.
        where: A filter in MLflow's language; empty for all.
        columns: Beside the run's name.
        order: Column by which runs are sorted.
        descending: The greatest first.
        bars: Metrics drawn as a bar per run.
        lines: Metrics drawn over their steps, a line per run.
        groups: Parameters whose equal values are one row, with the mean of its metrics.
        board: Whether it is a look at the table; else at the runs of nodes and sweeps.
    """

    key: str
    name: str
    where: str = ""
    columns: Sequence[str] = ()
    order: str = "tags.mlflow.runName"
    descending: bool = False
    bars: Sequence[str] = ()
    lines: Sequence[str] = ()
    groups: Sequence[str] = ()
    board: bool = True


class Board(Protocol):
    """The rows of a table, and looks at it."""

    def entry(self, node: Node, folder: Path) -> Entry | None:
        """The row of a finished node; None for a node without one.

        Raises:
            DamagedFileError: A file of the node's artifact is damaged.
        """

    def views(self) -> Sequence[View]:
        """Prepared looks at the table and at the runs."""
