"""Tables of the benchmark: 10th percentiles of every algorithm and dataset, beside the thesis's."""

from collections.abc import Mapping
from typing import Final

import pandas as pd

from components.reporting.thesis_numbers import thesis_numbers
from docs.result_tables.shared import DATA, NAMES, logged, table_of

_CONTROLLERS: Final = ("bad", "mediocre", "optimized")
_OTHERWISE: Final = "ddpg"
"""The thesis discounts its returns with 0.99 instead of 0.97: no number to stand beside ours."""

_APART: Final = 2.0
"""Combined standard errors from which on two results are said to differ."""

Numbers = Mapping[tuple[str, str], tuple[float, float]]
"""(dataset, column) -> (10th percentile, standard error)."""


def measured() -> tuple[Numbers, Mapping[str, float]]:
    """What was measured, and LION's best λ by dataset.

    LION has two columns: `best`, the λ with the highest 10th percentile, and `one`, λ = 1.
    """
    table = pd.read_csv(DATA / "full-width-2026-11.csv")
    lion = table[table["algorithm"] == "lion"]
    best = lion.loc[lion.groupby("dataset")["tenth_percentile"].idxmax()]
    parts = [
        table[table["algorithm"] != "lion"],
        best.assign(algorithm="best"),
        lion[lion["lambda"] == 1].assign(algorithm="one"),
    ]
    rows = pd.concat(parts).itertuples()
    numbers = {(r.dataset, r.algorithm): (r.tenth_percentile, r.standard_error) for r in rows}
    return numbers, dict(zip(best["dataset"], best["lambda"], strict=True))


def front() -> str:
    """One row per algorithm: means over the logs of each controller, beside the thesis's."""
    numbers, _ = measured()
    logs = logged()
    thesis = thesis_numbers()

    def mean(controller: str, values: Mapping[str, float]) -> float:
        found = [value for name, value in values.items() if name.startswith(controller)]
        return sum(found) / len(found)

    rows = [["logged behaviour", *(f"{mean(c, logs):.1f}" for c in _CONTROLLERS), "", ""]]
    for column, name in NAMES.items():
        ours = {log: numbers[log, column][0] for log in logs}
        theirs = {log: thesis[log, column][0] for log in logs if (log, column) in thesis}
        cells = [f"{mean(c, ours):.1f}" for c in _CONTROLLERS]
        rank = ""
        if theirs and column != _OTHERWISE:
            means = [f"{mean(c, theirs):.1f}" for c in _CONTROLLERS]
            cells = [f"{cell} ({other})" for cell, other in zip(cells, means, strict=True)]
        if theirs:
            pair = pd.DataFrame({"ours": ours, "theirs": theirs})
            rank = f"{pair['ours'].corr(pair['theirs'], method='spearman'):.2f}"
        above = sum(ours[log] > logs[log] for log in logs)
        rows.append([name, *cells, f"{above} of {len(logs)}", rank])
    count = {c: sum(log.startswith(c) for log in logs) for c in _CONTROLLERS}
    heads = [f"{c} ({count[c]} logs)" for c in _CONTROLLERS]
    return table_of(["", *heads, "above the log on", "Spearman with the thesis"], rows)


def full() -> str:
    """One row per dataset: 10th percentiles and standard errors, the best of a row in bold."""
    numbers, best = measured()
    rows = []
    for log, mean in logged().items():
        top = max(numbers[log, column][0] for column in NAMES)
        cells = [log, f"{mean:.1f}"]
        for column in NAMES:
            value, error = numbers[log, column]
            shown = f"**{value:.1f}**" if value == top else f"{value:.1f}"
            at = f" at {best[log]:g}" if column == "best" else ""
            cells.append(f"{shown} ({error:.1f}){at}")
        rows.append(cells)
    return table_of(["dataset", "log, mean", *NAMES.values()], rows)


def beside() -> str:
    """One row per dataset: ours and the thesis's, marked where they differ."""
    numbers, _ = measured()
    thesis = thesis_numbers()
    columns = [c for c in NAMES if ("bad-0.0", c) in thesis and c != _OTHERWISE]
    rows = []
    for log in logged():
        cells = [log]
        for column in columns:
            (ours, error), (theirs, their_error) = numbers[log, column], thesis[log, column]
            apart = abs(ours - theirs) > _APART * (error**2 + their_error**2) ** 0.5
            mark = (" ▲" if ours > theirs else " ▼") if apart else ""
            cells += [f"{ours:.1f}{mark}", f"{theirs:.1f} ({their_error:g})"]
        rows.append(cells)
    heads = [head for column in columns for head in (NAMES[column], "thesis")]
    return table_of(["dataset", *heads], rows)
