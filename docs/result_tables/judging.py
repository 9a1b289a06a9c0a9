"""Tables of how well scores that are computed from a log rank policies by their real returns."""

from typing import Final

import pandas as pd

from components.aggregation.selection import DEFAULT_SCORE, chosen_blind
from docs.result_tables.shared import DATA, table_of
from flows.report.selection import QUALITIES

_COMPARED: Final = ("model", "fitted_q", "least_of_both", DEFAULT_SCORE, "closeness")
"""Judges that are shown dataset by dataset."""


def judges() -> str:
    """One row per score: means over the datasets."""
    table = pd.read_csv(DATA / "judges-2026-11.csv")
    means = table.groupby("score", sort=False)[list(QUALITIES)].mean()
    rows = []
    for score, row in means.iterrows():
        bold = "**" if score == DEFAULT_SCORE else ""
        cells = [f"{row[name]:.{digits}f}" for name, digits in QUALITIES.items()]
        rows.append([f"{bold}`{score}`{bold}", *cells])
    return table_of(["score", *(name.replace("_", " ") for name in QUALITIES)], rows)


def judged() -> str:
    """One row per dataset: Spearman's correlation and the regret at 1 of some scores."""
    table = pd.read_csv(DATA / "judges-2026-11.csv").set_index(["dataset", "score"])
    rows = []
    for dataset in table.index.unique("dataset"):
        own = table.loc[dataset]
        cells = [f"{own.loc[s, 'regret_1']:.1f} ({own.loc[s, 'spearman']:.2f})" for s in _COMPARED]
        rows.append([dataset, *(cell.replace(" (nan)", "") for cell in cells)])
    return table_of(["dataset", *(f"`{score}`" for score in _COMPARED)], rows)


def blind() -> str:
    """One row per controller: the score chosen on the logs of the others, and how it does here."""
    table = pd.read_csv(DATA / "judges-2026-11.csv")
    shown = {"relative_regret": 2, "regret_1": 1, "spearman": 2, "exploits_caught": 2}
    means = table.groupby(["group", "score"])[list(shown)].mean()
    rows = []
    for group, chosen in chosen_blind(table, list(table["group"].unique())).items():
        for score in dict.fromkeys((chosen, DEFAULT_SCORE)):
            row = means.loc[group, score]
            cells = [f"{row[name]:.{digits}f}" for name, digits in shown.items()]
            who = "chosen blind" if score == chosen else "the default"
            if chosen == DEFAULT_SCORE:
                who += ", which is the default"
            rows.append([f"{group}: `{score}`, {who}", *(c.replace("nan", "") for c in cells)])
    return table_of(["logs", *(name.replace("_", " ") for name in shown)], rows)
