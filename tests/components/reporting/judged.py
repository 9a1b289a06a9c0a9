"""Judged logs made by hand: one whose promises lie outside of the log, one without an ensemble."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from components.aggregation.selection import scored
from components.reporting.judged import Choice, Judged, JudgedLog, Returns, choices

NAN = float("nan")
# proximity, gain by the ensemble, gain by the critics, share outside
TIMID = {
    "bc": [(NAN, -3.0, -1.0, 0.01)],
    "td3_bc": [(NAN, 16.0, 12.0, 0.08)],
    "lion": [
        (0.0, -2.0, -1.0, 0.01),
        (0.1, 8.0, 8.5, 0.01),
        (0.2, 18.0, 17.0, 0.46),
        (0.5, 25.0, 19.0, 0.96),
        (1.0, 27.0, 20.0, 1.0),
    ],
}
Rows = Sequence[tuple[float, float, float, float]]


def judgements(given: dict[str, Rows], usual: float = -70.0) -> pd.DataFrame:
    """Two seeds of every policy, one above and one below the mean, on one log."""
    rows: list[dict[str, Any]] = []
    for algorithm, points in given.items():
        for proximity, model, critics, outside in points:
            for seed in (0, 1):
                apart = 0.5 - seed
                rows.append(
                    {
                        "dataset": "timid",
                        "algorithm": algorithm,
                        "seed": seed,
                        "step": 100,
                        "proximity": proximity,
                        "model": usual + model + apart,
                        "model_error": 0.6,
                        "model_least": usual + model - 2.0,
                        "fitted_q": usual + critics + apart,
                        "fitted_q_error": 0.8,
                        "distance": 0.1 if np.isnan(proximity) else proximity,
                        "outside": outside,
                        "promised": NAN if np.isnan(proximity) else model + 1.0,
                        "policy": f"key{seed}",
                        "run": f"{algorithm}/timid/seed{seed}",
                        "hardware": "2 x a processor",
                        "commit": "a1b2c3d",
                        "true_return": NAN,
                    }
                )
    same = {
        "model": usual,
        "model_least": usual - 1.0,
        "fitted_q": usual,
        "distance": 0.0,
        "outside": 0.01,
        "model_error": 0.8,
        "fitted_q_error": 0.6,
    }
    return pd.DataFrame(rows).assign(**{f"{name}_usual": value for name, value in same.items()})


def found(given: dict[str, Rows], **changes: Any) -> list[Choice]:
    """The choices of such a log, with some columns of its judgements changed."""
    return choices(scored(judgements(given).assign(**changes)))


def log(given: dict[str, Rows] | None = None, **changes: Any) -> JudgedLog:
    """A log of it."""
    usual = JudgedLog(
        "timid",
        "timid",
        found(given or TIMID),
        Returns(-70.0, -90.0, -50.0),
        {"episodes": "60", "columns of the state": "temperature, oxygen"},
    )
    return replace(usual, **changes)


def without_ensemble() -> JudgedLog:
    """A log whose policies take no λ and were judged by critics alone."""
    fixed = {name: TIMID[name] for name in ("bc", "td3_bc")}
    unknown = {f"model{part}": NAN for part in ("", "_error", "_least")}
    usual = {f"{name}_usual": NAN for name in unknown}
    return log(fixed, name="critics", choices=found(fixed, **unknown, **usual))


def judged(**changes: Any) -> Judged:
    """Everything that a page shows, with some of it changed."""
    whole = Judged(
        sweeps={"own": "python -m flows.full_benchmark sweep=own"},
        logs=[log(), without_ensemble(), log(name="waiting", choices=[], progress=["No."])],
        policies=judgements(TIMID),
        notes=["Something <b>odd</b> happened."],
        costs=pd.DataFrame([{"work": "judging", "of": "lion", "hours": 0.5}]),
        software=pd.DataFrame([{"computer": "a", "nodes": 3}]),
        budget="profile quick, 2 seeds",
    )
    return replace(whole, **changes)
