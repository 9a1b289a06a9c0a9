"""Is the offline judgement borne out? Estimates of judges beside the returns on the plant."""

from collections.abc import Mapping
from typing import Final

import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import spearmanr

__all__ = ["borne_out", "chosen", "comparison", "comparison_figure"]

_KEYS: Final = ["algorithm", "seed", "proximity"]
_ESTIMATES: Final = {
    "model": "the judges' ensemble",
    "fitted_q": "fitted Q evaluation",
    "score_cautious_1": "the ensemble, less a price for the share outside",
    "outside": "share outside of the log's support, less is better",
}


def comparison(judgements: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """A row for each policy and proximity: what the judges said and what the plant did.

    Raises:
        ValueError: Not every policy on the plant was judged before.
    """
    joined = trials.merge(judgements.drop(columns="true_return"), on=_KEYS, how="left")
    if joined["model"].isna().any():
        raise ValueError("Some policies were not judged; run the sweep and the trial again.")
    return joined


def borne_out(joined: pd.DataFrame) -> pd.DataFrame:
    """Spearman's rank correlation of every estimate with the return on the plant.

    Returns:
        By `estimate`: `all` policies, and those of `lion` alone.
    """
    lion = joined[joined["algorithm"] == "lion"]
    rows = []
    for name, words in _ESTIMATES.items():
        sign = -1 if name == "outside" else 1
        correlations = {
            kind: float(spearmanr(sign * some[name], some["return"]).statistic)
            for kind, some in (("all", joined), ("lion", lion))
        }
        rows.append({"estimate": words, **correlations})
    return pd.DataFrame(rows)


def chosen(joined: pd.DataFrame) -> pd.DataFrame:
    """What would have been chosen by every score of the judges, and what it does on the plant.

    Returns:
        By `score`: the best `algorithm` and `proximity` in the mean of the seeds, with `return` and
        `euros_per_hour` on the plant; the last row is the best in truth.
    """
    keys = ["algorithm", "proximity"]
    scores = [name for name in joined.columns if name.startswith("score_")]
    truth = ["return", "euros_per_hour"]
    means = joined.groupby(keys, dropna=False)[[*scores, *truth]].mean().reset_index()
    rows = []
    for name in [*scores, "return"]:
        row = means.iloc[int(means[name].to_numpy().argmax())]
        words = "(truth)" if name == "return" else name.removeprefix("score_")
        rows.append({"score": words, **{str(key): row[key] for key in [*keys, *truth]}})
    return pd.DataFrame(rows)


def comparison_figure(joined: pd.DataFrame, operators: Mapping[str, float]) -> Figure:
    """Returns and estimates of LION over the proximity, and how far it is from the log."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    lion = joined[joined["algorithm"] == "lion"]
    for column, label, style in (
        ("return", "on the plant", "ko-"),
        ("model", "judges' ensemble", "C0s--"),
        ("fitted_q", "fitted Q evaluation", "C1^--"),
    ):
        for number, (_, one) in enumerate(lion.groupby("seed")):
            above.plot(
                one["proximity"], one[column], style, ms=4, label=label if number == 0 else None
            )
    above.axhline(operators["return"], color="0.5", label="operators on the plant")
    above.set_ylabel("discounted 100-step return, euros")
    above.legend()
    for _, one in lion.groupby("seed"):
        below.plot(one["proximity"], 100 * one["outside"], "C3.-")
    below.set_ylabel("outside of the log, %")
    below.set_xlabel("proximity λ")
    return figure
