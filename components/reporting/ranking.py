"""Tables of a ranking of datasets: thesis table 4.1 with our numbers, correlations, clips.

Every number is made from what was measured of the logs and, where a sweep has finished, from the
10th percentiles of its policies.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, Final

import pandas as pd

from components.data.advice import initial_proximities, limitation
from components.data.indicators import (
    LogFacts,
    combined_ranks,
    combined_scores,
    expected_return_improvement,
    ranks,
    spearman,
    true_return_improvement,
)

__all__ = [
    "Measured",
    "clip_table",
    "correlation_table",
    "markdown",
    "ranked_for_people",
    "ranking_table",
    "thesis_ranks",
    "true_improvements",
]

_INDICATORS: Final = ("eri", "eas", "coi")
_WITHOUT: Final = "bad"
"""Controller whose datasets the thesis leaves out of its second correlations: anything is better
than that controller, exploration included."""


@dataclass(frozen=True)
class Measured:
    """What is known of a log.

    Attributes:
        facts: What it shows without any network.
        floor: Return from which its returns are counted.
        eas: Expected action stochasticity.
        over_clips: The same for other clips.
        achieved: By algorithm, the 10th percentile of the policies of a sweep.
        generated: Whether its share of random actions is known, since this project has made it.
    """

    facts: LogFacts
    floor: float
    eas: float
    over_clips: Mapping[float, float]
    achieved: Mapping[str, float] = field(default_factory=dict)
    generated: bool = True

    @property
    def name(self) -> str:
        """Name of the dataset."""
        return self.facts.name

    @property
    def eri(self) -> float:
        """Expected return improvement."""
        return expected_return_improvement(self.facts, self.floor)

    def improvement(self, algorithm: str) -> float:
        """True return improvement by an algorithm; NaN where it has no result."""
        achieved = self.achieved.get(algorithm, math.nan)
        return true_return_improvement(achieved, self.facts, self.floor)


@cache
def thesis_ranks() -> pd.DataFrame:
    """Table 4.1: ranks of ERI, EAS, COI and TRI by dataset, 0 the least."""
    file = resources.files("components.reporting").joinpath("thesis", "table_4_1.csv")
    with file.open(encoding="utf-8") as opened:
        return pd.read_csv(opened, index_col="dataset")


def ranking_table(logs: Sequence[Measured], algorithm: str | None) -> pd.DataFrame:
    """One row per log, the most promising first.

    Args:
        logs: Of one ranking.
        algorithm: Whose true improvement is shown; None: no sweep has finished.

    Returns:
        Columns by name; NaN where the thesis has no such log or there is no result.
    """
    eri, eas = [log.eri for log in logs], [log.eas for log in logs]
    rows = []
    places = zip(
        ranks(eri), ranks(eas), combined_scores(eri, eas), combined_ranks(eri, eas), strict=True
    )
    for log, (eri_rank, eas_rank, score, coi_rank) in zip(logs, places, strict=True):
        low, high = initial_proximities(log.facts, log.eas)
        rows.append(
            {
                "dataset": log.name,
                "episodes": log.facts.episodes,
                "terminated": log.facts.terminated,
                "transitions": log.facts.transitions,
                "return_mean": log.facts.return_mean,
                "return_max": log.facts.return_max,
                "return_floor": log.floor,
                "eri": log.eri,
                "eri_rank": eri_rank,
                "eas": log.eas,
                "eas_rank": eas_rank,
                "coi_score": score,
                "coi_rank": coi_rank,
                "proximity_from": low,
                "proximity_to": high,
                "limit": limitation(log.facts, log.eri, log.eas),
            }
        )
    table = pd.DataFrame(rows)
    if algorithm is not None:
        table["tri"] = [log.improvement(algorithm) for log in logs]
        known = table["tri"].notna()
        table.loc[known, "tri_rank"] = ranks(table.loc[known, "tri"])
    known = table["dataset"].isin(thesis_ranks().index)
    for name, published in thesis_ranks().items():
        # Among these logs: where all sixteen are ranked, the published ranks themselves.
        found = ranks(published[table.loc[known, "dataset"]])
        table[f"thesis_{name}"] = pd.Series(found, table.index[known], dtype="float64")
    return table.sort_values("coi_rank", ascending=False, kind="stable").reset_index(drop=True)


def ranked_for_people(table: pd.DataFrame) -> pd.DataFrame:
    """The table as it is shown: ranks count from 1, and a single log has none.

    Those of :func:`ranking_table` count from 0, as the thesis's published ones do.
    """
    names = [str(name) for name in table if str(name).endswith("_rank")]
    if len(table) < 2:
        return table.drop(columns=names)
    return table.assign(**{name: table[name] + 1 for name in names})


def true_improvements(logs: Sequence[Measured]) -> dict[str, pd.Series]:
    """By algorithm, the true return improvements of the logs on which it has a result."""
    names = dict.fromkeys(name for log in logs for name in log.achieved)
    found = {}
    for name in names:
        values = {log.name: log.improvement(name) for log in logs if name in log.achieved}
        found[name] = pd.Series(values, dtype="float64").dropna()
    return found


def correlation_table(logs: Sequence[Measured]) -> pd.DataFrame:
    """Spearman's rank correlations of the indicators with what they are to predict.

    Returns:
        One row per target: true improvements by every algorithm of the sweep, the thesis's
        published ranks, the thesis's own indicators with these; and the agreement of every
        indicator with the thesis's. `_without` are those without the datasets of the bad
        controller. Targets that fewer than three of the logs have are left out.
    """
    own = pd.DataFrame({"eri": [log.eri for log in logs], "eas": [log.eas for log in logs]})
    own["coi"] = combined_ranks(own["eri"].tolist(), own["eas"].tolist())
    own.index = pd.Index([log.name for log in logs])
    plain = [log.name for log in logs if log.facts.controller != _WITHOUT]
    published = thesis_ranks().loc[[n for n in thesis_ranks().index if n in own.index]]
    theirs = published.rename(columns=lambda name: name.removesuffix("_rank"))
    targets = {
        f"true improvement by {name}": (own, dict.fromkeys(_INDICATORS, values))
        for name, values in true_improvements(logs).items()
    }
    same = dict.fromkeys(_INDICATORS, theirs["tri"])
    targets["the thesis's true improvement"] = (own, same)
    targets["thesis: its indicators and improvement"] = (theirs, same)
    targets["the same indicator in the thesis"] = (own, {n: theirs[n] for n in _INDICATORS})
    rows = []
    for name, (indicators, values) in targets.items():
        row: dict[str, Any] = {"target": name}
        for end, kept in (("", set(own.index)), ("_without", set(plain))):
            for indicator, target in values.items():
                shared = [n for n in target.index if n in kept]
                row[f"datasets{end}"] = len(shared)
                row[indicator + end] = spearman(indicators.loc[shared, indicator], target[shared])
        if row["datasets"] >= 3:
            rows.append(row)
    return pd.DataFrame(rows)


def clip_table(logs: Sequence[Measured]) -> pd.DataFrame:
    """EAS of every log for every clip, and what the clip does to the order of the logs.

    Returns:
        One row per clip: `clip`, the logs by name, `spearman_chosen` with the order of the clip
        that is used, and `spearman_thesis` with that of table 4.1.
    """
    chosen = [log.eas for log in logs]
    known = [log for log in logs if log.name in thesis_ranks().index]
    theirs = thesis_ranks().loc[[log.name for log in known], "eas_rank"]
    rows = []
    for clip in sorted({clip for log in logs for clip in log.over_clips}):
        own = {log.name: log.over_clips[clip] for log in logs}
        rows.append(
            {
                "clip": clip,
                **own,
                "spearman_chosen": spearman(list(own.values()), chosen),
                "spearman_thesis": spearman([own[log.name] for log in known], theirs),
            }
        )
    return pd.DataFrame(rows)


def markdown(table: pd.DataFrame, digits: Mapping[str, int]) -> str:
    """A table as aligned Markdown.

    Args:
        table: With unique columns.
        digits: Decimals of columns of numbers; the others are text. NaN is an empty cell.
    """
    lines = []
    for name in table.columns:
        number = name in digits
        cells = [
            ("" if pd.isna(value) else f"{value:.{digits[name]}f}") if number else str(value)
            for value in table[name]
        ]
        width = max(map(len, [name, *cells]))
        rule = "-" * (width - 1) + ":" if number else "-" * width
        whole = [name, rule, *cells]
        lines.append([cell.rjust(width) if number else cell.ljust(width) for cell in whole])
    return "".join(f"| {' | '.join(cells)} |\n" for cells in zip(*lines, strict=True))
