"""Make the result tables of README.md and docs/: ``python -m docs.result_tables``.

The numbers come from docs/results/ and from the thesis's tables in the package. A table stands
between two comments, ``<!-- table NAME -->`` and ``<!-- end of NAME -->``; what was there is
replaced. A test holds the pages against the data.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from components.aggregation.selection import DEFAULT_SCORE, chosen_blind
from components.algorithms.wsbc import Config as WSBCConfig
from components.reporting.ranking import markdown
from components.reporting.thesis_numbers import thesis_numbers
from flows.studies.finished import decimals

ROOT: Final = Path(__file__).resolve().parents[1]
PAGES: Final = (
    ROOT / "README.md",
    *(
        ROOT / "docs" / f"{n}.md"
        for n in ("results", "world", "judging", "studies", "autopilot", "caution")
    ),
)

_DATA: Final = ROOT / "docs" / "results"
_NAMES: Final = {
    "bc": "BC",
    "ddpg": "DDPG",
    "bcq": "BCQ",
    "td3_bc": "TD3+BC",
    "wsbc": "WSBC",
    "best": "LION, best λ",
    "one": "LION, λ = 1",
}
_CONTROLLERS: Final = ("bad", "mediocre", "optimized")
_OTHERWISE: Final = "ddpg"
"""The thesis discounts its returns with 0.99 instead of 0.97: no number to stand beside ours."""

_APART: Final = 2.0
"""Combined standard errors from which on two results are said to differ."""

_HAPPENS: Final = 0.6
"""The λ from which on policies of the 2-D world leave the log."""

Numbers = Mapping[tuple[str, str], tuple[float, float]]
"""(dataset, column) -> (10th percentile, standard error)."""


def measured() -> tuple[Numbers, Mapping[str, float]]:
    """What was measured, and LION's best λ by dataset.

    LION has two columns: `best`, the λ with the highest 10th percentile, and `one`, λ = 1.
    """
    table = pd.read_csv(_DATA / "full-width-2026-11.csv")
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


def logged() -> Mapping[str, float]:
    """The mean return of every log, in the order of the tables."""
    table = pd.read_csv(_DATA / "logged-behaviour.csv")
    return dict(zip(table["dataset"], table["mean_return"], strict=True))


def front() -> str:
    """One row per algorithm: means over the logs of each controller, beside the thesis's."""
    numbers, _ = measured()
    logs = logged()
    thesis = thesis_numbers()

    def mean(controller: str, values: Mapping[str, float]) -> float:
        found = [value for name, value in values.items() if name.startswith(controller)]
        return sum(found) / len(found)

    rows = [["logged behaviour", *(f"{mean(c, logs):.1f}" for c in _CONTROLLERS), "", ""]]
    for column, name in _NAMES.items():
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
    return _markdown(["", *heads, "above the log on", "Spearman with the thesis"], rows)


def full() -> str:
    """One row per dataset: 10th percentiles and standard errors, the best of a row in bold."""
    numbers, best = measured()
    rows = []
    for log, mean in logged().items():
        top = max(numbers[log, column][0] for column in _NAMES)
        cells = [log, f"{mean:.1f}"]
        for column in _NAMES:
            value, error = numbers[log, column]
            shown = f"**{value:.1f}**" if value == top else f"{value:.1f}"
            at = f" at {best[log]:g}" if column == "best" else ""
            cells.append(f"{shown} ({error:.1f}){at}")
        rows.append(cells)
    return _markdown(["dataset", "log, mean", *_NAMES.values()], rows)


def beside() -> str:
    """One row per dataset: ours and the thesis's, marked where they differ."""
    numbers, _ = measured()
    thesis = thesis_numbers()
    columns = [c for c in _NAMES if ("bad-0.0", c) in thesis and c != _OTHERWISE]
    rows = []
    for log in logged():
        cells = [log]
        for column in columns:
            (ours, error), (theirs, their_error) = numbers[log, column], thesis[log, column]
            apart = abs(ours - theirs) > _APART * (error**2 + their_error**2) ** 0.5
            mark = (" ▲" if ours > theirs else " ▼") if apart else ""
            cells += [f"{ours:.1f}{mark}", f"{theirs:.1f} ({their_error:g})"]
        rows.append(cells)
    heads = [head for column in columns for head in (_NAMES[column], "thesis")]
    return _markdown(["dataset", *heads], rows)


def world() -> str:
    """The 2-D world over λ; where little happens, one row in four."""
    table = pd.read_csv(_DATA / "world-2026-11.csv")
    shown = table[(table["λ"] >= _HAPPENS) | ((table["λ"] * 5) % 1 < 1e-9)]
    rows = ([f"{value:.2f}" for value in row] for row in shown.to_numpy())
    return _markdown(list(table.columns), rows)


_PACE: Final = (5, 10, 20, 50, 100)
"""Iterations of WSBC that are shown."""


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
    return _markdown(["dataset", "limit", *map(str, _PACE), "pool"], rows)


def limits() -> str:
    """One row per dataset: WSBC's pool at the former and at the chosen velocity limit."""
    table, logs, thesis = _velocities(), logged(), thesis_numbers()
    chosen = WSBCConfig().velocity_limit
    measured_ones = table.set_index(["dataset", "velocity_limit"])
    rows = []
    for log, mean in logs.items():
        cells = [
            f"{_pool(measured_ones.loc[log, limit].set_index('iteration')):.1f}"
            if (log, limit) in measured_ones.index
            else ""
            for limit in (1.0, chosen)
        ]
        if any(cells):
            theirs, error = thesis[log, "wsbc"]
            rows.append([log, f"{mean:.1f}", *cells, f"{theirs:.1f} ({error:g})"])
    heads = ["dataset", "log, mean", "limit 1", f"limit {chosen:g}", "thesis, 10th percentile"]
    return _markdown(heads, rows)


_CHOSEN_ON: Final = ("bad-0.4", "mediocre-0.2", "optimized-0.6")
"""The datasets on which the limit was chosen."""


def _velocities() -> pd.DataFrame:
    return pd.read_csv(_DATA / "wsbc-velocity-2026-11.csv").sort_values(
        ["dataset", "velocity_limit", "iteration"], ascending=[True, False, True]
    )


def _pool(own: pd.DataFrame) -> float:
    """Mean return of the last tenth of a run's snapshots."""
    return float(own["mean_return"].iloc[-max(1, len(own) // 10) :].mean())


_JUDGES: Final = {
    "spearman": 2,
    "regret_1": 1,
    "regret_5": 1,
    "relative_regret": 2,
    "caught": 2,
    "exploits_caught": 2,
    "cleared": 2,
}
"""How well judges rank: columns and decimals."""

_COMPARED: Final = ("model", "fitted_q", "least_of_both", DEFAULT_SCORE, "closeness")
"""Judges that are shown dataset by dataset."""


def judges() -> str:
    """One row per score: means over the datasets."""
    table = pd.read_csv(_DATA / "judges-2026-11.csv")
    means = table.groupby("score", sort=False)[list(_JUDGES)].mean()
    rows = []
    for score, row in means.iterrows():
        bold = "**" if score == DEFAULT_SCORE else ""
        cells = [f"{row[name]:.{digits}f}" for name, digits in _JUDGES.items()]
        rows.append([f"{bold}`{score}`{bold}", *cells])
    return _markdown(["score", *(name.replace("_", " ") for name in _JUDGES)], rows)


def judged() -> str:
    """One row per dataset: Spearman's correlation and the regret at 1 of some scores."""
    table = pd.read_csv(_DATA / "judges-2026-11.csv").set_index(["dataset", "score"])
    rows = []
    for dataset in table.index.unique("dataset"):
        own = table.loc[dataset]
        cells = [f"{own.loc[s, 'regret_1']:.1f} ({own.loc[s, 'spearman']:.2f})" for s in _COMPARED]
        rows.append([dataset, *(cell.replace(" (nan)", "") for cell in cells)])
    return _markdown(["dataset", *(f"`{score}`" for score in _COMPARED)], rows)


def blind() -> str:
    """One row per controller: the score chosen on the logs of the others, and how it does here."""
    table = pd.read_csv(_DATA / "judges-2026-11.csv")
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
    return _markdown(["logs", *(name.replace("_", " ") for name in shown)], rows)


_SEARCHES: Final = ("autopilot", "first drop", "first drop of 10")


def autopilot() -> str:
    """One row per dataset: what searches for λ end with, their worst step, what they use."""
    table = pd.read_csv(_DATA / "autopilot-2026-11.csv")
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
    return _markdown(["dataset", "clone", "best", *heads], rows)


def autopilot_slopes() -> str:
    """One row per slope and budget."""
    table = pd.read_csv(_DATA / "autopilot-slopes-2026-11.csv")
    digits = {name: 2 for name in ("gained", "possible", "worst", "below")}
    rows = (
        [f"{value:.{digits.get(name, 0)}f}" for name, value in row.items()]
        for row in table.to_dict("records")
    )
    return _markdown(list(table.columns), rows)


def _cautions() -> pd.DataFrame:
    return pd.read_csv(_DATA / "caution-2026-11.csv", keep_default_na=True)


def _shown(row: Mapping[str, float | str]) -> list[str]:
    """Which policy a row is about."""
    proximity = row["proximity"]
    name = str(_NAMES.get(str(row["algorithm"]), "LION"))
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
    return _markdown(["dataset", "policy", *heads], rows)


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
    return _markdown(["dataset", "policy", "caution", "log", *heads], rows)


def study(name: str) -> str:
    """The table of a study, as `python -m flows.study` prints it."""
    table = pd.read_csv(_DATA / "studies-2026-11" / f"{name}.csv")
    return markdown(table, decimals(table))


TABLES: Final[Mapping[str, Callable[[], str]]] = {
    "front": front,
    "full": full,
    "beside": beside,
    "world": world,
    "pace": pace,
    "limits": limits,
    "judges": judges,
    "judged": judged,
    "blind": blind,
    "lion_over_lambda": lambda: study("figure-6.5"),
    "rvs_returns": lambda: study("figure-6.8"),
    "autopilot": autopilot,
    "autopilot_slopes": autopilot_slopes,
    "warnings": warnings,
    "caution": caution,
}


def filled(text: str) -> str:
    """A page with its tables made anew.

    Raises:
        KeyError: It asks for a table that is none of `TABLES`.
    """

    def table(found: re.Match[str]) -> str:
        name = found[1]
        return f"<!-- table {name} -->\n\n{TABLES[name]()}\n<!-- end of {name} -->"

    return re.sub(r"<!-- table (\w+) -->.*?<!-- end of \1 -->", table, text, flags=re.DOTALL)


def _markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    rule = ["---", *("--:" for _ in heads[1:])]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (heads, rule, *rows))


def main() -> None:
    """Write the pages."""
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
