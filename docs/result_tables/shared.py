"""What the tables share: where the data lie, how algorithms are called, how a table is written."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

ROOT: Final = Path(__file__).resolve().parents[2]
DATA: Final = ROOT / "docs" / "results"

NAMES: Final = {
    "bc": "BC",
    "ddpg": "DDPG",
    "bcq": "BCQ",
    "td3_bc": "TD3+BC",
    "wsbc": "WSBC",
    "best": "LION, best λ",
    "one": "LION, λ = 1",
}
"""Algorithms by their columns in the data, in the order of the tables."""


def logged() -> Mapping[str, float]:
    """The mean return of every log, in the order of the tables."""
    table = pd.read_csv(DATA / "logged-behaviour.csv")
    return dict(zip(table["dataset"], table["mean_return"], strict=True))


def table_of(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are numbers and stand to the right."""
    rule = ["---", *("--:" for _ in heads[1:])]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (heads, rule, *rows))
