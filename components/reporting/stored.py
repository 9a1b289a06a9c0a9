"""Read the stored report of a sweep: table, summaries and behaviour returns.

A report is a folder ``STORE/reports/SWEEP``. Its ``report.json`` names the nodes behind it by their
keys: the summaries are artifacts of aggregation nodes, ``STORE/nodes/KEY/summary.json``, and the
cards of the datasets ``STORE/nodes/KEY/dataset/card.json``. Sweeps share these nodes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd
from matplotlib.figure import Figure

from components.core.cards import CardFormat
from components.core.files import write_json
from components.core.sealed import check_digest, read_sealed_json, with_digest
from components.reporting.figures import proximity_figure
from components.reporting.tables import read_results, with_undefined

__all__ = [
    "ReportNodes",
    "StoredReport",
    "figures_over_proximity",
    "find_store",
    "open_report",
]

_NODES: Final = "report.json"
_VERSION: Final = ("format_version", 1)


@dataclass(frozen=True)
class ReportNodes:
    """The nodes behind a report.

    Attributes:
        aggregations: Keys of its aggregation nodes, in the table's order.
        datasets: Name of a dataset -> key of the node that generated it.
    """

    aggregations: tuple[str, ...]
    datasets: Mapping[str, str]

    def save(self, report: Path) -> Path:
        """Write them into a report's folder; returns the file."""
        write_json(report / _NODES, dict([_VERSION]) | with_digest(asdict(self)))
        return report / _NODES

    @classmethod
    def load(cls, report: Path) -> "ReportNodes":
        """Read them from a report's folder.

        Raises:
            FileNotFoundError: An older version wrote the report and did not store them.
            ValueError: The file is damaged or of another version.
        """
        return _FORMAT.read(report / _NODES)


_FORMAT: Final = CardFormat(
    kind=ReportNodes,
    what="complete report",
    remedy="give the sweep's command again to write it",
    version=_VERSION,
    amend=check_digest,
)


@dataclass(frozen=True)
class StoredReport:
    """A sweep's report.

    Attributes:
        folder: Its folder, which has the name of the sweep.
        table: As :func:`~components.reporting.tables.result_table` made it.
        summaries: The summaries behind the rows, in their order; fewer if artifacts are missing.
        behaviour_returns: Dataset -> mean discounted 100-step return of the logging controller.
    """

    folder: Path
    table: pd.DataFrame
    summaries: Sequence[Mapping[str, Any]]
    behaviour_returns: Mapping[str, float]


def find_store(name: str | Path) -> Path:
    """The nearest folder of this name with reports, from the working directory upwards.

    Args:
        name: A relative path such as ``mlruns``, or an absolute one.

    Raises:
        FileNotFoundError: There is none.
    """
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / name / "reports").is_dir():
            return folder / name
    raise FileNotFoundError(
        f"No folder {name} with reports in {here} or above; run the benchmark first, or set "
        "PROXIMITY_STORE to the folder of its runs."
    )


def open_report(store: Path, sweep: str | None = None) -> StoredReport:
    """Read one sweep's report.

    Args:
        store: Folder of all outputs of runs.
        sweep: Its name; may be None or empty if there is only one. Of several, none is taken by
            its age: the newest may be a test, and a copied store has lost the ages.

    Raises:
        FileNotFoundError: No such sweep, or none at all, has a report there, or an older version
            wrote it.
        DamagedFileError: A file of the report is damaged.
        ValueError: There are several reports and none is named.
    """
    tables = {path.parent.name: path for path in store.glob("reports/*/results.csv")}
    if not tables:
        raise FileNotFoundError(f"{store} holds no report yet; run the benchmark to make one.")
    names = ", ".join(sorted(tables))
    if not sweep and len(tables) > 1:
        raise ValueError(
            f"{store} holds the reports of several sweeps: {names}; name one, in the notebook by "
            "PROXIMITY_SWEEP."
        )
    if sweep and sweep not in tables:
        raise FileNotFoundError(f"{store} holds no report of {sweep!r}; there are {names}.")
    table = tables[sweep] if sweep else next(iter(tables.values()))
    report_nodes = ReportNodes.load(table.parent)
    nodes = store / "nodes"
    summaries = [
        read_sealed_json(nodes / key, "summary.json")
        for key in report_nodes.aggregations
        if (nodes / key).exists()
    ]
    cards = {
        name: read_sealed_json(nodes / key, "dataset/card.json")
        for name, key in report_nodes.datasets.items()
        if (nodes / key).exists()
    }
    summaries = [with_undefined(summary) for summary in summaries]
    returns = {name: float(card["first_window_return_mean"]) for name, card in cards.items()}
    return StoredReport(table.parent, read_results(table), summaries, returns)


def figures_over_proximity(report: StoredReport) -> dict[str, Figure]:
    """A figure per dataset that has policies with a proximity parameter."""
    figures = {}
    for dataset, behaviour_return in report.behaviour_returns.items():
        own = [summary for summary in report.summaries if summary["dataset"] == dataset]
        figure = proximity_figure(dataset, own, behaviour_return)
        if figure is not None:
            figures[dataset] = figure
    return figures
