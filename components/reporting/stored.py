"""Read back what a sweep has left on disk: table, summaries, behaviour returns. Files only.

A report folder ``STORE/reports/SWEEP`` holds the table; the summaries behind it are artifacts of
aggregation nodes, ``STORE/nodes/KEY/summary.json``, shared by all sweeps that needed them. A
summary belongs to a report if all of its rows stand in the report's table, number by number: the
table is stored in full precision. Nothing is recomputed.
"""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from components.reporting.figures import proximity_figure
from components.reporting.tables import COLUMNS, result_rows

__all__ = ["StoredReport", "figures_over_lambda", "find_store", "open_report", "read_results"]

_TEXTS = ("dataset", "algorithm")
_COUNTS = ("seeds", "policies")
Row = Mapping[str, Any]


@dataclass(frozen=True)
class StoredReport:
    """A sweep's report.

    Attributes:
        folder: Where it lies; its name is the sweep's.
        rows: The table, one mapping with all ``COLUMNS`` per row; None where a cell is empty.
        summaries: The summaries behind the rows, in their order; fewer if artifacts are missing.
        behaviour_returns: Dataset -> mean discounted 100-step return of the logging controller.
    """

    folder: Path
    rows: Sequence[Row]
    summaries: Sequence[Row]
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
        store: Folder that everything of a run is left in.
        sweep: Its name; the newest one if None.

    Raises:
        FileNotFoundError: No such sweep, or none at all, has a report there.
    """
    tables = sorted(store.glob("reports/*/results.csv"), key=lambda path: path.stat().st_mtime)
    if not tables:
        raise FileNotFoundError(f"{store} holds no report yet; run the benchmark to make one.")
    names = [path.parent.name for path in tables]
    if sweep is not None and sweep not in names:
        raise FileNotFoundError(
            f"{store} holds no report of {sweep!r}; there are {', '.join(sorted(names))}."
        )
    table = tables[-1] if sweep is None else tables[names.index(sweep)]
    rows = read_results(table)
    found = _summaries(store / "nodes", rows)
    returns = {}
    for folder, summary in found:
        value = _behaviour_return(folder)
        if value is not None:
            returns[summary["dataset"]] = value
    return StoredReport(table.parent, rows, [summary for _, summary in found], returns)


def read_results(path: Path) -> list[dict[str, Any]]:
    """A ``results.csv`` as typed rows, the inverse of ``results_csv``.

    Raises:
        ValueError: The file has other columns.
    """
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(
                f"{path} has the columns {reader.fieldnames}; a table of results has "
                f"{', '.join(COLUMNS)}."
            )
        return [{name: _value(name, text) for name, text in row.items()} for row in reader]


def _value(column: str, text: str) -> str | int | float | None:
    if column in _TEXTS:
        return text
    if not text:
        return None
    return int(text) if column in _COUNTS else float(text)


def _summaries(nodes: Path, rows: Sequence[Row]) -> list[tuple[Path, dict[str, Any]]]:
    """Folder and content of the summaries whose rows are among ``rows``, in their order."""
    place = {_identity(row): number for number, row in reversed(list(enumerate(rows)))}
    found = {}
    for path in nodes.glob("*/summary.json"):
        summary = json.loads(path.read_text(encoding="utf-8"))
        own = [_identity(row) for row in result_rows([summary])]
        if own and all(row in place for row in own):
            found[place[own[0]]] = path.parent, summary
    return [found[number] for number in sorted(found)]


def _identity(row: Row) -> tuple[Any, ...]:
    """A row by its text, so that what is not a number equals itself too."""
    return tuple(str(row[name]) for name in COLUMNS)


def _behaviour_return(node: Path) -> float | None:
    """The return on the card of the dataset that a node was made from, however indirectly."""
    card = node / "dataset" / "card.json"
    if card.is_file():
        return float(json.loads(card.read_text(encoding="utf-8"))["first_window_return_mean"])
    record = node / "node.json"
    if not record.is_file():
        return None
    for key in json.loads(record.read_text(encoding="utf-8"))["inputs"].values():
        value = _behaviour_return(node.parent / key)
        if value is not None:
            return value
    return None


def figures_over_lambda(report: StoredReport) -> dict[str, Figure]:
    """A figure per dataset that has policies with a proximity parameter."""
    figures = {}
    for dataset, behaviour_return in report.behaviour_returns.items():
        own = [summary for summary in report.summaries if summary["dataset"] == dataset]
        figure = proximity_figure(dataset, own, behaviour_return)
        if figure is not None:
            figures[dataset] = figure
    return figures
