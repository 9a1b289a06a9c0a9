"""Tables of what keeps a machine from harm: a careful search for λ, and caution in training."""

from collections.abc import Mapping
from typing import Final

import pandas as pd

from docs.result_tables.shared import DATA, NAMES, table_of

_SEARCHES: Final = ("autopilot", "first drop", "first drop of 10")


def autopilot() -> str:
    """One row per dataset: what searches for λ end with, their worst step, what they use."""
    table = pd.read_csv(DATA / "autopilot-2026-11.csv")
    rows = []
    for row in table.to_dict("records"):
        cells = [row["dataset"], f"{row['clone']:.1f}", f"{row['best']:.1f}"]
        for name in _SEARCHES:
            cells += [
                f"{row[f'{name}: return']:.1f} at {row[f'{name}: λ']:.2f}",
                f"{row[f'{name}: worst']:.1f}",
                f"{row[f'{name}: trajectories']:.0f}",
            ]
        rows.append(cells)
    heads = [head for name in _SEARCHES for head in (name, "worst", "used")]
    return table_of(["dataset", "clone", "best", *heads], rows)


def autopilot_slopes() -> str:
    """One row per slope and budget."""
    table = pd.read_csv(DATA / "autopilot-slopes-2026-11.csv")
    digits = {name: 2 for name in ("gained", "possible", "worst", "below")}
    rows = (
        [f"{value:.{digits.get(name, 0)}f}" for name, value in row.items()]
        for row in table.to_dict("records")
    )
    return table_of(list(table.columns), rows)


def _cautions() -> pd.DataFrame:
    return pd.read_csv(DATA / "caution-2026-11.csv", keep_default_na=True)


def _shown(row: Mapping[str, float | str]) -> list[str]:
    """Which policy a row is about."""
    proximity = row["proximity"]
    name = str(NAMES.get(str(row["algorithm"]), "LION"))
    return [str(row["dataset"]), name if pd.isna(proximity) else f"LION, λ = {proximity:g}"]


def warnings() -> str:
    """One row per policy that was trained without caution: what was promised, and what warned."""
    rows = []
    for row in _cautions().to_dict("records"):
        if pd.isna(row["caution"]) and row["proximity"] not in (0.25, 0.5, 0.75):
            gain = row["real"] - row["logged"]
            numbers = f"{row['promised_gain']:+.1f}", f"{gain:+.1f}"
            measured = f"{row['distance']:.2f}", f"{row['disagreement']:.2f}"
            rows.append([*_shown(row), *numbers, *measured])
    heads = ["promised", "real", "distance", "disagreement"]
    return table_of(["dataset", "policy", *heads], rows)


def caution() -> str:
    """One row per policy that was trained with caution, too: promised and real returns."""
    table = _cautions()
    free = table[table["caution"].isna()]
    where = ["dataset", "algorithm", "proximity"]
    rows = []
    for row in table[table["caution"].notna()].to_dict("records"):
        same = (free[where].fillna(-1) == pd.Series(row)[where].fillna(-1)).all(axis=1)
        if not same.any():
            continue
        bold = free[same].iloc[0]
        cells = [*_shown(row), f"{row['caution']:g}, {row['caution_by']}", f"{row['logged']:.1f}"]
        for one in (bold, row):
            cells += [f"{one['promised_gain']:+.1f}", f"{one['real']:.1f}"]
        rows.append([*cells, f"{row['real'] - bold['real']:+.1f}"])
    heads = ["promised without", "real without", "promised with", "real with", "saved"]
    return table_of(["dataset", "policy", "caution", "log", *heads], rows)
