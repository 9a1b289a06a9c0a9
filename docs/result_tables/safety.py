"""Tables of what keeps a machine from harm: a careful search for λ, and caution in training."""

from collections.abc import Mapping, Sequence
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
    """One row per log: LION at its freest and WSBC without and with a price on leaving the log."""
    return _prices(["caution"])


def caution_by() -> str:
    """Likewise, of the logs on which both measures have been charged for."""
    return _prices(["caution", "caution-disagreement"])


def _prices(studies: Sequence[str]) -> str:
    """What the logs that all these studies have are worth without and with their prices."""
    tables = [pd.read_csv(DATA / "studies-2026-11" / f"{name}.csv") for name in studies]
    logs = [log for log in dict.fromkeys(tables[0]["dataset"]) if all(_has(t, log) for t in tables)]
    columns: dict[str, list[float]] = {}
    level = {}
    for policy in ("LION, λ = 1", "WSBC"):
        for table in tables:
            own = table[table["policy"] == policy].set_index("dataset").loc[logs]
            level = own["log"].to_dict()
            columns[policy] = list(own["without"])
            columns[f"{policy}, {own['price'].iloc[0]}"] = list(own["with"])
    rows = [
        [log, f"{level[log]:.1f}", *(f"{values[i]:.1f}" for values in columns.values())]
        for i, log in enumerate(logs)
    ]
    below = (sum(map(float.__lt__, own, level.values())) for own in columns.values())
    rows.append(["mean", "", *(f"{sum(own) / len(own):.1f}" for own in columns.values())])
    rows.append(["below the log on", "", *(f"{count} of {len(logs)}" for count in below)])
    return table_of(["dataset", "log", *columns], rows)


def _has(table: pd.DataFrame, log: str) -> bool:
    return bool((table["dataset"] == log).any())
