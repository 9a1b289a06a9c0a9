"""What the policies of a finished sweep have achieved on given datasets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from components.core.integrity import DamagedFileError
from components.reporting.stored import ReportNodes, open_report
from flows.configuration.settings import SettingsError

__all__ = ["Achieved", "achieved"]


@dataclass(frozen=True)
class Achieved:
    """Results on some datasets.

    Attributes:
        sweep: Name of the sweep; empty if there is none.
        percentiles: By dataset and algorithm, the 10th percentile; of a policy that takes a
            proximity at its best one, and the algorithm is called so.
        note: A sentence about sweeps that were not used; empty if there is nothing to say.
    """

    sweep: str
    percentiles: Mapping[str, Mapping[str, float]]
    note: str = ""

    def algorithm(self, wanted: str | None) -> str | None:
        """The name of the algorithm whose improvement is shown; None if there is none.

        Args:
            wanted: As the settings say; None stands for MOOSE, or else the first.

        Raises:
            SettingsError: The sweep has no such result.
        """
        names = list(dict.fromkeys(name for own in self.percentiles.values() for name in own))
        for name in names:
            if name.partition(" ")[0] == (wanted or "moose"):
                return name
        if wanted is not None:
            has = f"has {', '.join(names)}" if names else "there is no sweep with results"
            raise SettingsError(f"ranking.algorithm={wanted}: no result of it; {has}.")
        return names[0] if names else None


def achieved(store: Path, datasets: Mapping[str, str], wanted: str | None) -> Achieved:
    """Read the results of a sweep on exactly these datasets.

    Args:
        store: Folder of everything that is kept.
        datasets: Name -> key of the node that has generated it: a sweep on data of other sizes or
            another seed says nothing about these.
        wanted: Name of the sweep; None: the only one with results on any of the datasets.

    Raises:
        SettingsError: The wanted sweep has no report, or no result on any of the datasets.
        DamagedFileError: A file of the report is damaged.
    """
    names = sorted(path.parent.name for path in store.glob("reports/*/results.csv"))
    if wanted is not None and wanted not in names:
        there = f"there are {', '.join(names)}" if names else "there is none"
        raise SettingsError(f"report={wanted}: {store} has no such report; {there}.")
    found = {}
    for name in [wanted] if wanted is not None else names:
        try:
            results = _results(store, name, datasets)
        except (FileNotFoundError, ValueError, DamagedFileError):
            if wanted is not None:
                raise
            continue  # of another version, or damaged: it was not asked for
        if results:
            found[name] = results
    if wanted is not None and not found:
        raise SettingsError(
            f"report={wanted} has no results on these datasets; give the sweep's own datasets, "
            "sizes and data.seed."
        )
    if len(found) == 1:
        [(sweep, results)] = found.items()
        return Achieved(sweep, results)
    note = (
        f"Several sweeps have results on these datasets: {', '.join(found)}; name one by "
        "report=NAME to see the true improvements."
    )
    return Achieved("", {}, note if found else "")


def _results(store: Path, name: str, datasets: Mapping[str, str]) -> dict[str, dict[str, float]]:
    made_from = ReportNodes.load(store / "reports" / name).datasets
    table = open_report(store, name).table.dropna(subset="tenth_percentile")
    results: dict[str, dict[str, float]] = {}
    for (dataset, algorithm), rows in table.groupby(["dataset", "algorithm"], sort=False):
        if dataset not in datasets or made_from.get(dataset) != datasets[dataset]:
            continue
        best = rows.loc[rows["tenth_percentile"].idxmax()]
        adapts = bool(rows["proximity"].notna().any())
        label = f"{algorithm} at its best λ" if adapts else str(algorithm)
        results.setdefault(str(dataset), {})[label] = float(best["tenth_percentile"])
    return results
