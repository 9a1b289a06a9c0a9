"""Tables of what a dial or a setting does: λ, the return RvS asks for, WSBC's velocity limit."""

from typing import Final

import pandas as pd

from components.reporting.ranking import markdown
from components.reporting.thesis_numbers import thesis_numbers
from docs.result_tables.shared import DATA, table_of
from flows.studies.finished import decimals

_HAPPENS: Final = 0.6
"""The λ from which on policies of the 2-D world leave the log."""

_PACE: Final = (5, 10, 20, 50, 100)
"""Iterations of WSBC that are shown."""

_ON_THE_WAY: Final = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Shares of MOOSE's updates that are shown."""

_DIALS: Final = {"lion": "LION", "lambda_td3_bc": "λ-TD3+BC", "rvs": "RvS", "mopo": "MOPO"}
"""Policies with a dial, by name."""

_CHOSEN: Final = 0.1
"""WSBC's velocity limit, the default."""

_CHOSEN_ON: Final = ("bad-0.4", "mediocre-0.2", "optimized-0.6")
"""The datasets on which the limit was chosen."""


def world() -> str:
    """The 2-D world over λ; where little happens, one row in four."""
    table = pd.read_csv(DATA / "world-2026-11.csv")
    shown = table[(table["λ"] >= _HAPPENS) | ((table["λ"] * 5) % 1 < 1e-9)]
    rows = ([f"{value:.2f}" for value in row] for row in shown.to_numpy())
    return table_of(list(table.columns), rows)


def study(name: str) -> str:
    """The table of a study, as `python -m flows.study` prints it."""
    table = pd.read_csv(DATA / "studies-2026-11" / f"{name}.csv")
    return markdown(table, decimals(table))


def dials() -> str:
    """One row per log: peak, area and zigzag of the curves of all policies with a dial."""
    table = _dials()
    wide = table.pivot(index="dataset", columns="algorithm")
    rows = []
    for log in dict.fromkeys(table["dataset"]):
        own = ((wide.loc[log, (of, name)] for of in ("peak", "area", "zigzag")) for name in _DIALS)
        rows.append([log, *(" / ".join(f"{value:.1f}" for value in cell) for cell in own)])
    return table_of(["dataset", *_DIALS.values()], rows)


def dials_means() -> str:
    """One row per policy with a dial: means over the logs, and on how many it is the best."""
    table = _dials()
    columns = ["first", "peak", "area", "greatest fall", "zigzag", "first drop"]
    means = table.groupby("algorithm")[columns].mean()
    best = {
        of: table.loc[table.groupby("dataset")[of].idxmax(), "algorithm"].value_counts()
        for of in ("peak", "area")
    }
    rows = []
    for name, shown in _DIALS.items():
        counts = [f"{best[of].get(name, 0)}" for of in ("peak", "area")]
        rows.append([shown, *(f"{means.loc[name, column]:.1f}" for column in columns), *counts])
    return table_of(["", *columns, "best peak on", "best area on"], rows)


def _dials() -> pd.DataFrame:
    return pd.read_csv(DATA / "studies-2026-11" / "dials.csv")


def chosen_blind() -> str:
    """Figure 6.9: one row per log, errors at λ = 0 on unseen episodes by eta and Beta."""
    table = pd.read_csv(DATA / "studies-2026-11" / "figure-6.9.csv")
    table["of"] = [
        f"η = {eta:g}, Beta({b:g})" for eta, b in zip(table.eta, table.beta, strict=True)
    ]
    wide = table.pivot(index="dataset", columns="of", values="error")
    columns = list(dict.fromkeys(table["of"]))
    clone = table.groupby("dataset")["clone"].first()
    rows = (
        [log, f"{clone[log]:.3f}", *(f"{wide.loc[log, column]:.3f}" for column in columns)]
        for log in wide.index
    )
    return table_of(["dataset", "clone", *columns], rows)


def bad_alone() -> str:
    """One row per setting of LION on bad-0.0 that was changed alone."""
    table = pd.read_csv(DATA / "bad-0.0-2026-11.csv", keep_default_na=False)
    rows = (
        [
            f"`{row['setting']}`" if row["setting"] else "none",
            f"{row['seeds']}",
            f"{row['held_out_error']:.5f}",
            f"{row['best_tenth_percentile']:.1f} at {row['best_proximity']:g}",
            f"{row['best_mean']:.1f}",
            f"{row['tenth_percentile_at_1']:.1f}",
        ]
        for row in table.to_dict("records")
    )
    heads = ["seeds", "held-out error", "10th percentile, best λ", "mean there", "at λ = 1"]
    return table_of(["changed", *heads], rows)


def box() -> str:
    """WSBC on bad-0.0 by the size of its box."""
    table = pd.read_csv(DATA / "wsbc-box-2026-11.csv")
    theirs, error = thesis_numbers()["bad-0.0", "wsbc"]
    heads = ["box, ±", *(f"{size:g}" for size in table["box"]), "thesis, ± 0.0125"]
    values = [f"{value:.1f}" for value in table["tenth_percentile"]]
    return table_of(heads, [["10th percentile", *values, f"{theirs:.1f} ({error:g})"]])


def autoencoder() -> str:
    """One row per run of MOOSE from a clone of Hopper's log: real returns on the way."""
    table = pd.read_csv(DATA / "moose-autoencoder-2026-11.csv")
    rows = []
    for (epochs, updates, seed), own in table.groupby(["epochs", "updates", "seed"], sort=True):
        returns = own.sort_values("update")["return"].to_numpy()
        cells = [f"{returns[round(len(returns) * share) - 1]:.1f}" for share in _ON_THE_WAY]
        rows.append([f"{epochs}", f"{updates}", f"{seed}", *cells])
    heads = [f"{share:.0%}" for share in _ON_THE_WAY]
    return table_of(["autoencoder's epochs", "updates", "seed", *heads], rows)


def pace() -> str:
    """One row per dataset and velocity limit of WSBC: real and expected returns on the way."""
    table = _velocities()
    rows = []
    for (dataset, limit), own in table.groupby(["dataset", "velocity_limit"], sort=False):
        if dataset not in _CHOSEN_ON:
            continue
        own = own.set_index("iteration")
        cells = [f"{own.mean_return[n]:.1f} ({own.expected_return[n]:.1f})" for n in _PACE]
        rows.append([dataset, f"{limit:g}", *cells, f"{_pool(own):.1f}"])
    return table_of(["dataset", "limit", *map(str, _PACE), "pool"], rows)


def limits() -> str:
    """One row per log: WSBC's returns on the way at the former and at the chosen limit."""
    table = pd.read_csv(DATA / "studies-2026-11" / "pace.csv")
    limits = list(dict.fromkeys(table["limit"]))
    stages = ("quarter", "half", "end")
    rows = []
    for dataset, own in table.groupby("dataset", sort=False):
        by_limit = own.set_index("limit")
        found = (by_limit.loc[limit, stage] for limit in limits for stage in stages)
        theirs, error = thesis_numbers()[dataset, "wsbc"]
        cells = [f"{by_limit['log'].iloc[0]:.1f}", *(f"{value:.1f}" for value in found)]
        rows.append([dataset, *cells, f"{theirs:.1f} ({error:g})"])
    means = [table[table["limit"] == limit][stage].mean() for limit in limits for stage in stages]
    rows.append(["mean", "", *(f"{mean:.1f}" for mean in means), ""])
    heads = [f"{limit:g}: {stage}" for limit in limits for stage in stages]
    return table_of(["dataset", "log", *heads, "thesis, 10th percentile"], rows)


def swarm() -> str:
    """One row per log: WSBC with a small and with a larger swarm at the chosen limit."""
    small = pd.read_csv(DATA / "studies-2026-11" / "pace.csv")
    small = small[small["limit"] == _CHOSEN].set_index("dataset")
    large = pd.read_csv(DATA / "wsbc-swarm-2026-11.csv").set_index("dataset")
    stages = ("quarter", "half", "end", "tenth_percentile", "promised")
    rows = []
    for dataset, own in small.iterrows():
        log = str(dataset)
        theirs, error = thesis_numbers()[log, "wsbc"]
        found = [own["end"], *(large.loc[log, stage] for stage in stages)]
        numbers = [f"{own['log']:.1f}", *(f"{value:.1f}" for value in found)]
        rows.append([log, *numbers, f"{theirs:.1f} ({error:g})"])
    heads = ["log", "24: end", "100: quarter", "half", "end", "10th percentile", "promised"]
    return table_of(["dataset", *heads, "thesis"], rows)


def _velocities() -> pd.DataFrame:
    return pd.read_csv(DATA / "wsbc-velocity-2026-11.csv").sort_values(
        ["dataset", "velocity_limit", "iteration"], ascending=[True, False, True]
    )


def _pool(own: pd.DataFrame) -> float:
    """Mean return of the last tenth of a run's snapshots."""
    return float(own["mean_return"].iloc[-max(1, len(own) // 10) :].mean())
