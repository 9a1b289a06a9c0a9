"""Tables of judged policies: which to take, and how well judges have ranked where it is known."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.selection import quality
from components.reporting.ranking import markdown

__all__ = ["judge_table", "selection_markdown", "selection_table"]

_SHOWN: Final = {
    "dataset": "dataset",
    "algorithm": "algorithm",
    "proximity": "proximity",
    "policies": "policies",
    "score": "score",
    "model": "gain, ensemble",
    "model_error": "±",
    "fitted_q": "gain, critics",
    "fitted_q_error": "± ",
    "outside": "outside",
    "distance": "distance",
}
"""Columns that are printed, headed as on the report's page. Headings differ by blanks, which
Markdown does not show."""
_DIGITS: Final = {"proximity": 2, "policies": 0, "distance": 2, "outside": 2}
_FIRST: Final = 12
"""Rows of a dataset that are printed, beside the best row of every algorithm."""


def selection_table(policies: pd.DataFrame, score: str) -> pd.DataFrame:
    """Judged policies, those of all seeds and snapshots together, best first in each dataset.

    Args:
        policies: Of :func:`components.aggregation.selection.scored`, one row a policy.
        score: Name of the score by which they are ordered.

    Returns:
        Columns ``dataset``, ``algorithm``, ``proximity``, ``policies`` (how many), ``score`` (its
        mean; 0 is the behaviour policy's), the means of all estimates and scores, the errors of the
        estimates, and ``true_return``.
    """
    columns = [str(name) for name in policies]
    errors = [name for name in columns if name.endswith("_error")]
    squared = policies.assign(**{name: policies[name] ** 2 for name in errors})
    grouped = squared.groupby(["dataset", "algorithm", "proximity"], dropna=False, sort=False)
    named = {name: (name, "mean") for name in columns if name not in _KEYS}
    table = grouped.agg(
        policies=("step", "size"), score=(f"score_{score}", "mean"), **named
    ).reset_index()
    for name in errors:
        # Of the mean of several policies: their own errors and their spread.
        spread = grouped[name.removesuffix("_error")].var().fillna(0.0).to_numpy()
        table[name] = ((table[name] + spread) / table["policies"]) ** 0.5
    order = table["dataset"].map({name: n for n, name in enumerate(table["dataset"].unique())})
    ordered = table.assign(order=order).sort_values(
        ["order", "score"], ascending=[True, False], kind="stable", ignore_index=True
    )
    return ordered.drop(columns="order")


_KEYS: Final = ("dataset", "algorithm", "proximity", "seed", "step", "policy")


def selection_markdown(table: pd.DataFrame) -> str:
    """The first rows of every dataset of :func:`selection_table`, and the best of every algorithm.

    Estimates are shown as gains over the behaviour policy, with the errors of both together.
    """
    first = table.groupby("dataset", sort=False).cumcount() < _FIRST
    best = ~table.duplicated(["dataset", "algorithm"])
    shown = table[first | best]
    gains = {name: shown[name] - shown[f"{name}_usual"] for name in ("model", "fitted_q")} | {
        name: np.hypot(shown[name], shown[f"{name}_usual"])
        for name in ("model_error", "fitted_q_error")
    }
    digits = {v: _DIGITS.get(k, 1) for k, v in _SHOWN.items() if k not in ("dataset", "algorithm")}
    return markdown(shown.assign(**gains)[list(_SHOWN)].rename(columns=_SHOWN), digits)


def judge_table(
    policies: pd.DataFrame,
    behaviour_returns: Mapping[str, float],
    controllers: Mapping[str, str],
) -> pd.DataFrame:
    """How well every score ranks, dataset by dataset: rows of :func:`.quality`.

    Args:
        policies: As :func:`selection_table` takes them; datasets without true returns are left out.
        behaviour_returns: Mean return of the controller that logged each dataset.
        controllers: Its name, by which the datasets are grouped, in the column ``group``.
    """
    known = policies.dropna(subset=["true_return"])
    rows = [
        quality(own, behaviour_returns[str(name)]).assign(
            dataset=name, group=controllers[str(name)], policies=len(own)
        )
        for name, own in known.groupby("dataset", sort=False)
    ]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()
