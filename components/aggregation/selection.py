"""Offline policy selection: which policy to take by estimates alone, and how well that works.

A *score* makes one number of a policy's estimates, the greater the better. Each is compared to that
of the behaviour policy, which was judged beside the others. Where true returns are known, a score
is measured by what it is for:

- Spearman's rank correlation with them;
- regret at k: how far the best of the k first-ranked policies stays below the best of all;
- caught: the share of harmful policies that it places below the behaviour policy. Harmful is what
  really earns less than the log's controller, by more than :data:`HARM` of its return; an *exploit*
  is harmful although the ensemble it was trained in promised a gain;
- cleared: the share of policies better than the log's controller that it places above.

Fu et al., "Benchmarks for Deep Off-Policy Evaluation" (2021) measure with the first two.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

__all__ = [
    "DEFAULT_SCORE",
    "ESTIMATES",
    "HARM",
    "SCORES",
    "chosen_blind",
    "quality",
    "scored",
]

ESTIMATES: Final = ("model", "model_least", "fitted_q", "distance", "outside")
"""Estimates that scores are made of; each also exists for the behaviour policy, as ``NAME_usual``
."""

HARM: Final = 0.1
"""Loss against the log's controller, as a share of its return, that is harm."""

Score = Callable[[pd.DataFrame], pd.Series]


def _gain(table: pd.DataFrame, name: str) -> pd.Series:
    """Of an estimate over that of the behaviour policy."""
    return table[name] - table[f"{name}_usual"]


def _model(table: pd.DataFrame) -> pd.Series:
    """By the ensemble; by the critics where there is none."""
    return _gain(table, "model").fillna(_gain(table, "fitted_q"))


def _both(table: pd.DataFrame) -> pd.Series:
    """The smaller gain, by the least member of the ensemble or by the critics."""
    gains = [_gain(table, name) for name in ("model_least", "fitted_q")]
    return pd.concat(gains, axis=1).min(axis=1)


def _cautious(score: Score, price: float) -> Score:
    """A gain less a price for steps outside the support, in the behaviour policy's own return."""

    def less_price(table: pd.DataFrame) -> pd.Series:
        strayed = _gain(table, "outside").clip(lower=0.0)
        usual = table["model_usual"].fillna(table["fitted_q_usual"]).abs()
        return score(table) - price * usual * strayed

    return less_price


_PRICES: Final = (0.1, 0.25, 0.5, 1.0, 2.0)

SCORES: Final[Mapping[str, Score]] = MappingProxyType(
    {
        "model": _model,
        "model_least": lambda table: _gain(table, "model_least").fillna(_gain(table, "fitted_q")),
        "fitted_q": lambda table: _gain(table, "fitted_q"),
        "least_of_both": _both,
        **{f"cautious_{price:g}": _cautious(_model, price) for price in _PRICES},
        **{f"cautious_both_{price:g}": _cautious(_both, price) for price in _PRICES},
        "closeness": lambda table: -_gain(table, "distance"),
        "support": lambda table: -_gain(table, "outside"),
    }
)
"""By name: gains over the behaviour policy, whose own score is 0.

- ``model``: of the mean return in the held-out ensemble; ``model_least``: by its least member. Logs
  without an ensemble are judged by the critics in its place.
- ``fitted_q``: by fitted critics; ``least_of_both``: the smaller of the two before.
- ``cautious_C``, ``cautious_both_C``: ``model`` and ``least_of_both``, less C times the behaviour
  policy's return for steps outside the support.
- ``closeness``, ``support``: nothing but nearness to the behaviour policy, or to the log. They are
  controls: they know no reward.
"""


DEFAULT_SCORE: Final = "cautious_0.5"
"""Of least regret over the sixteen datasets of the Industrial Benchmark, see docs/judging.md."""


def scored(table: pd.DataFrame) -> pd.DataFrame:
    """The table with a column for every score."""
    return table.assign(**{f"score_{name}": score(table) for name, score in SCORES.items()})


def quality(table: pd.DataFrame, behaviour_return: float) -> pd.DataFrame:
    """How well every score ranks the policies of one dataset.

    Args:
        table: Of :func:`scored`, with ``true_return`` and ``promised``; one row a policy.
        behaviour_return: Mean return of the log's controller.

    Returns:
        A row a score: ``spearman``, ``regret_1``, ``regret_5`` in returns, ``caught`` and
        ``exploits_caught`` and ``cleared`` as shares, NaN where there are no such policies; and
        ``relative_regret``, the mean of both regrets as a share of the range of true returns.
    """
    true = table["true_return"].to_numpy()
    best, spread = true.max(), np.ptp(true)
    harmful = true < behaviour_return - HARM * abs(behaviour_return)
    exploit = harmful & (table["promised"].to_numpy() > 0)
    better = true > behaviour_return
    rows = []
    for name in SCORES:
        score = table[f"score_{name}"].to_numpy()
        order = np.argsort(-score, kind="stable")
        regret = [float(best - true[order[:k]].max()) for k in (1, 5)]
        rows.append(
            {
                "score": name,
                "spearman": _correlation(score, true),
                "regret_1": regret[0],
                "regret_5": regret[1],
                "relative_regret": sum(regret) / len(regret) / spread if spread else 0.0,
                "caught": _share(score < 0, harmful),
                "exploits_caught": _share(score < 0, exploit),
                "cleared": _share(score > 0, better),
            }
        )
    return pd.DataFrame(rows)


def _correlation(score: np.ndarray, true: np.ndarray) -> float:
    """Spearman's; NaN where one of both does not vary."""
    if not np.ptp(score) or not np.ptp(true):
        return float("nan")
    return float(spearmanr(score, true).statistic)


def _share(of: np.ndarray, among: np.ndarray) -> float:
    return float(of[among].mean()) if among.any() else float("nan")


def chosen_blind(qualities: pd.DataFrame, groups: Sequence[str]) -> dict[str, str]:
    """For each group of datasets the best score on all others, by relative regret.

    Args:
        qualities: Rows of :func:`quality` with a column ``group``.
        groups: Groups, e.g. the controllers that logged the datasets.
    """
    chosen = {}
    for group in groups:
        others = qualities[qualities["group"] != group]
        chosen[group] = str(others.groupby("score")["relative_regret"].mean().idxmin())
    return chosen
