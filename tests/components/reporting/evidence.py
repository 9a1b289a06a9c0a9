"""Evidence made by hand: two logs, four algorithms, a gap."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from components.aggregation.across import Estimate, Ranks
from components.reporting.evidence import Across, Cell, Evidence, Gap, Log
from components.reporting.overview import overview
from components.reporting.tables import result_table
from components.reporting.thesis_numbers import Thesis

GRID = np.array([0.0, 0.5, 1.0])
LEVELS = {"bad-0.4": -214.0, "mediocre-0.2": -77.0}
SYSTEM = "proximity/IndustrialBenchmark-v0"


def cell(dataset: str, algorithm: str, *levels: float) -> Cell:
    """Two seeds, four snapshots, one of them pooled; every seed is one apart from the mean."""
    places = GRID if len(levels) > 1 else np.array([np.nan])
    rising = np.linspace(-30.0, 0.0, 4)[None, :, None]
    returns = np.array(levels)[None, None, :] + rising + np.array([-1.0, 1.0])[:, None, None]
    points = [
        {
            "lambda": None if np.isnan(place) else float(place),
            "policies": 2,
            "tenth_percentile": level - 0.8,
            "standard_error": 1.7,
            "mean": level,
            "std": 1.4,
            "iqm": level,
            "seed_std": 1.4,
            "distance": 0.1 if np.isnan(place) else float(place),
            "interval_low": level - 1.0,
            "interval_high": level + 1.0,
        }
        for place, level in zip(places, levels, strict=True)
    ]
    steps = np.arange(1, 5) * 250
    level = LEVELS[dataset]
    return Cell(dataset, algorithm, algorithm, [0, 1], steps, places, returns, 1, points, level)


CELLS = [
    cell("bad-0.4", "bc", -220.0),
    cell("bad-0.4", "ddpg", -151.0),
    cell("bad-0.4", "td3_bc", -213.5),
    cell("bad-0.4", "lion", -219.0, -120.0, -70.0),
    cell("mediocre-0.2", "bc", -78.0),
    cell("mediocre-0.2", "ddpg", -327.0),
    cell("mediocre-0.2", "lion", -77.5, -71.0, -250.0),
]
THESIS = {
    ("bad-0.4", "td3_bc"): Thesis(-230.0, 2.0, "²"),
    ("bad-0.4", "ddpg"): Thesis(-383.0, 7.0, "¹", other_discount=True),
}


def summary(cell: Cell) -> dict[str, Any]:
    """What aggregation would have stored."""
    own = {"dataset": cell.dataset, "algorithm": cell.algorithm, "seeds": list(cell.seeds)}
    return own | {"points": cell.points}


def evidence(**changes: Any) -> Evidence:
    """A report's evidence, with some of its attributes changed."""
    footnotes = {"¹": "other discount.", "²": "less."}
    table = overview(result_table(map(summary, CELLS)), LEVELS, THESIS, footnotes)
    columns = table.columns
    wide = Estimate(np.array([1.0, 0.5]), np.array([0.9, 0.4]), np.array([1.0, 0.6]))
    shares = [
        [None if i == j else Estimate(0.7, 0.6, 0.8) for j in range(len(columns))]
        for i in range(len(columns))
    ]
    across = Across(
        ["bad-0.4"],
        columns,
        [Estimate(0.1 * n, 0.1 * n - 0.05, 0.1 * n + 0.05) for n in range(len(columns))],
        np.array([0.0, 1.0]),
        [wide] * len(columns),
        shares,
        Ranks(np.arange(1.0, len(columns) + 1), 2.5, 0.04),
    )
    found = Evidence(
        sweeps={"toy": "python -m flows.full_benchmark sweep=toy"},
        logs={n: Log(n, SYSTEM, level, level + 5, "100 episodes") for n, level in LEVELS.items()},
        cells={(c.dataset, c.algorithm): c for c in CELLS},
        gaps=[Gap("mediocre-0.2", "td3_bc", "1 of 2 seeds evaluated")],
        table=table,
        thesis=THESIS,
        notes=["Something <b>odd</b> happened."],
        costs=pd.DataFrame([{"work": "training", "of": "bc", "hours": 0.001}]),
        across=across,
        budget="profile quick, 2 seeds",
    )
    return replace(found, **changes)
