"""The table of all that can be chosen on a judged log, as people read it."""

from typing import Final

import pandas as pd

from components.reporting.judged import JudgedLog

__all__ = ["choice_table", "digits_of"]

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
_SHARES: Final = ("λ", "outside", "distance")


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
