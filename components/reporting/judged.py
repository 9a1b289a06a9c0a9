"""Policies that were judged from a log alone, as a report shows them: what can be chosen."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import pandas as pd

from components.aggregation.selection import DEFAULT_SCORE
from components.reporting.leads import Lead
from components.reporting.selection import selection_table

__all__ = [
    "TRAINED_BY",
    "Choice",
    "Gain",
    "Judged",
    "JudgedLog",
    "Returns",
    "algorithms_of",
    "choice_table",
    "choices",
    "digits_of",
]

_RETURNS: Final = (
    "score",
    "gain, ensemble",
    "±",
    "least member",
    "gain, critics",
    "± ",
    "promised in training",
)
"""Columns of returns; two of errors differ by a blank, which nobody sees."""
TRAINED_BY: Final = ("run", "hardware", "commit")
"""Columns on what trained a policy."""

_SHARES: Final = ("λ", "outside", "distance")


@dataclass(frozen=True)
class Gain:
    """What a judge expects of a policy beyond the behaviour that it sees in the log.

    Attributes:
        value: Difference of the discounted returns.
        error: Standard error of it: both returns' errors together, as if they were independent.
    """

    value: float
    error: float


@dataclass(frozen=True)
class Choice:
    """What can be chosen: an algorithm's policies of all seeds, at one proximity.

    Attributes:
        algorithm: Label of the algorithm.
        proximity: λ; None where the policies take none.
        policies: How many there are.
        score: The default score, above 0 where it is better than the behaviour.
        model: Gain by the held-out ensemble; None where there is none.
        sceptical: Gain by the ensemble's least favourable values; None likewise.
        critics: Gain by fitted critics.
        distance: Mean distance to the behaviour's action.
        outside: Share of the steps outside of the log's support.
        usually_outside: That of the behaviour itself.
        promised: Gain in the ensemble that they were trained in; None where there was none.
        run: Run of the seed that scores best.
        leads: Where the ensemble expects it to lead the plant; empty where that is not known.
    """

    algorithm: str
    proximity: float | None
    policies: int
    score: float
    model: Gain | None
    sceptical: float | None
    critics: Gain
    distance: float
    outside: float
    usually_outside: float
    promised: float | None
    run: str
    leads: Sequence[Lead] = ()

    @property
    def name(self) -> str:
        """For sentences."""
        at = "" if self.proximity is None else f" at λ {self.proximity:.2f}"
        return f"{self.algorithm}{at}"

    @property
    def expected(self) -> Gain:
        """By the ensemble; by the critics where there is none."""
        return self.model or self.critics

    @property
    def gains(self) -> Mapping[str, Gain]:
        """By the judge's name."""
        found = {"the ensemble": self.model, "the critics": self.critics}
        return {name: gain for name, gain in found.items() if gain is not None}


@dataclass(frozen=True)
class Returns:
    """Returns of a log's episodes, by its card."""

    mean: float
    least: float
    greatest: float


@dataclass(frozen=True)
class JudgedLog:
    """A log without a real system, and what was judged from it.

    Attributes:
        name: Label, unique within the report.
        dataset: Name of the dataset.
        choices: Best first by the default score; none before the log's policies are judged.
        returns: Of its episodes; None where the log is not there yet.
        facts: Its card in words, by heading.
        doubts: Sentences on judges that contradict the log itself.
        progress: How far it is, if it is not finished.
        guess: The λ that a ranking of logs would try at first, from and to; None without one.
    """

    name: str
    dataset: str
    choices: Sequence[Choice]
    returns: Returns | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    doubts: Sequence[str] = ()
    progress: Sequence[str] = ()
    guess: tuple[float, float] | None = None

    @property
    def scale(self) -> float:
        """By which numbers are rounded: the size of the log's returns."""
        known = self.returns
        return 0.0 if known is None else max(abs(known.mean), known.greatest - known.least)

    @property
    def best(self) -> Choice | None:
        """What the default score would choose, be it better than the behaviour or not."""
        known = [choice for choice in self.choices if math.isfinite(choice.score)]
        return known[0] if known else None

    @property
    def decimals(self) -> int:
        """That tell a hundredth of the returns apart."""
        if not math.isfinite(self.scale) or self.scale <= 0.0:
            return 1
        return min(8, max(0, 2 - math.floor(math.log10(self.scale))))


@dataclass(frozen=True)
class Judged:
    """Everything that a report on judged policies shows.

    Attributes:
        sweeps: Names, with the command that repeats each.
        logs: What was judged, log by log.
        policies: A row per judged policy, snapshot and proximity, with all estimates.
        notes: Sentences on what the numbers do not show.
        costs: A row per algorithm: hours of training and judging, memory.
        software: A row per combination of software and device.
        budget: Profile and seeds, for titles.
    """

    sweeps: Mapping[str, str]
    logs: Sequence[JudgedLog]
    policies: pd.DataFrame
    notes: Sequence[str] = ()
    costs: pd.DataFrame = field(default_factory=pd.DataFrame)
    software: pd.DataFrame = field(default_factory=pd.DataFrame)
    budget: str = ""

    @property
    def algorithms(self) -> list[str]:
        """Labels, the best of the first log first."""
        return algorithms_of(self.logs)


def algorithms_of(logs: Sequence[JudgedLog]) -> list[str]:
    """Labels of all logs' algorithms."""
    return list(dict.fromkeys(choice.algorithm for log in logs for choice in log.choices))


def choices(
    policies: pd.DataFrame, leads: Mapping[tuple[str, float | None], Sequence[Lead]] | None = None
) -> list[Choice]:
    """What can be chosen on one log, best first by the default score.

    Args:
        policies: Of :func:`components.aggregation.selection.scored`, one row a policy of the log,
            with the errors of the behaviour policy's estimates and what trained each.
        leads: Where policies lead, by algorithm and λ, as far as it is known.
    """
    best = policies.sort_values(f"score_{DEFAULT_SCORE}", ascending=False, kind="stable")
    runs: dict[tuple[str, float | None], str] = {}
    for name, place, run in zip(best["algorithm"], best["proximity"], best["run"], strict=True):
        runs.setdefault((str(name), _known(float(place))), str(run))
    table = selection_table(policies.drop(columns=list(TRAINED_BY)), DEFAULT_SCORE)
    found = [_choice({str(k): v for k, v in row.items()}, runs) for row in table.to_dict("records")]
    known = leads or {}
    return [replace(c, leads=known.get((c.algorithm, c.proximity), ())) for c in found]


def choice_table(log: JudgedLog) -> pd.DataFrame:
    """A row per choice, best first; columns in which nothing is known are left out."""
    unknown = float("nan")
    rows = [
        {
            "policy": choice.algorithm,
            "λ": choice.proximity,
            "policies": choice.policies,
            "score": choice.score,
            "gain, ensemble": choice.model.value if choice.model else unknown,
            "±": choice.model.error if choice.model else unknown,
            "least member": choice.sceptical,
            "gain, critics": choice.critics.value,
            "± ": choice.critics.error,
            "outside": choice.outside,
            "distance": choice.distance,
            "promised in training": choice.promised,
        }
        for choice in log.choices
    ]
    numbers = {name: float for name in (*_RETURNS, *_SHARES)}
    table: pd.DataFrame = pd.DataFrame(rows).astype(numbers).dropna(axis="columns", how="all")
    return table


def digits_of(log: JudgedLog) -> dict[str, int]:
    """Decimals of its columns of numbers."""
    return {
        "policies": 0,
        **dict.fromkeys(_RETURNS, log.decimals),
        **dict.fromkeys(_SHARES, 2),
    }


def _choice(row: Mapping[str, float], runs: Mapping[tuple[str, float | None], str]) -> Choice:
    algorithm, proximity = str(row["algorithm"]), _known(row["proximity"])
    critics = _gain(row, "fitted_q")
    return Choice(
        algorithm=algorithm,
        proximity=proximity,
        policies=int(row["policies"]),
        score=row["score"],
        model=None if math.isnan(row["model"]) else _gain(row, "model"),
        sceptical=_known(row["model_least"] - row["model_least_usual"]),
        critics=critics,
        distance=row["distance"],
        outside=row["outside"],
        usually_outside=row["outside_usual"],
        promised=_known(row["promised"]),
        run=runs[algorithm, proximity],
    )


def _gain(row: Mapping[str, float], name: str) -> Gain:
    errors = row[f"{name}_error"], row[f"{name}_error_usual"]
    return Gain(row[name] - row[f"{name}_usual"], math.hypot(*errors))


def _known(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
