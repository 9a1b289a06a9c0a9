"""Policies over the proximity λ, thesis figures 6.5 to 6.7 and 6.10 to 6.14.

All of these figures have one layout, and answer the same questions: how good is a policy as a
clone of the log, where is it best, and how good is it at the free end? So do these studies; they
differ in what is trained.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.finished import Cell, cells, levels, panels, written
from flows.studies.study import Drawn, Study

__all__ = ["STUDIES", "proximity_table"]

_READ: Final = """\
Returns are means over the seeds. `below the log from λ`: the first λ from which on the return
stays more than 2 % below that of the log; empty where there is none. `drops`: how often one step
of λ loses more than 2 % of the log's return. `reach`: the largest difference between the returns
at any two λ.

"""
_LOSS: Final = 0.02
"""Share of the log's return that counts as a loss; smaller ones may be chance."""


def proximity_table(
    found: Sequence[Cell], level: dict[str, float], names: list[str]
) -> pd.DataFrame:
    """One row per cell."""
    rows = []
    for cell, name in zip(found, names, strict=True):
        returns, proximities = cell.returns, cell.column("lambda")
        log = level[cell.dataset]
        loss = _LOSS * abs(log)
        best = int(np.nanargmax(returns))
        # Undefined returns count as losses, hence "not above".
        good = np.flatnonzero(returns >= log - loss)
        after = good[-1] + 1 if len(good) else 0
        rows.append(
            {
                "dataset": cell.dataset,
                "policies": name,
                "log": log,
                "at 0": returns[0],
                "best": returns[best],
                "best λ": proximities[best],
                "at 1": returns[-1],
                "below the log from λ": proximities[after] if after < len(returns) else np.nan,
                "distance at 1": cell.column("distance")[-1],
                "drops": int((~(np.diff(returns) >= -loss)).sum()),
                "reach": np.nanmax(returns) - np.nanmin(returns),
            }
        )
    return pd.DataFrame(rows)


def _draw(
    plan: Plan,
    store: ArtifactStore,
    folder: Path,
    *,
    name: str,
    thesis: str,
    called: Callable[[Cell], str],
) -> Drawn:
    found = [cell for cell in cells(plan, store) if cell.points[0]["lambda"] is not None]
    level = levels(plan, store)
    names = [called(cell) for cell in found]
    lines = {
        dataset: [
            cell.line(shown)
            for cell, shown in zip(found, names, strict=True)
            if cell.dataset == dataset
        ]
        for dataset in dict.fromkeys(cell.dataset for cell in found)
    }
    table = proximity_table(found, level, names)
    figure = (panels(lines, level), "proximity λ", {})
    return written(folder, name, table, _READ + thesis, {name: figure})


def _study(
    name: str,
    about: str,
    thesis: str,
    *,
    subject: tuple[str, ...],
    defaults: tuple[str, ...],
    quick: tuple[str, ...] = (),
    takes: str,
    called: Callable[[Cell], str] = lambda cell: _NAMES.get(cell.algorithm, cell.algorithm),
) -> Study:
    return Study(
        name=name,
        about=about,
        subject=subject,
        defaults=defaults,
        quick=("profile=quick", "seeds=[0,1]", *quick),
        takes=takes,
        draw=partial(_draw, name=name, thesis=thesis, called=called),
    )


_NAMES: Final = {"lion": "LION", "lambda_td3_bc": "λ-TD3+BC", "rvs": "RvS"}
_AGGREGATIONS: Final = {
    "minimum": "least reward of four",
    "mean": "mean of four",
    "single": "one model alone",
}

STUDIES: Final = (
    _study(
        "figure-6.5",
        "LION over λ, also on robots: figures 6.5 to 6.7",
        """\
The thesis: on logs without exploration by mediocre and optimized controllers LION is good close
to λ = 0 alone; the more a log explores, the further the good range reaches, until with 80 % the
best λ is close to 1. With the bad controller it gains with freedom. Curves are smooth and
distances rise monotonously; on robots they are less smooth, and on Walker2D a local maximum is
followed by a loss of a quarter.
""",
        subject=("algorithms=[lion]",),
        defaults=(
            "datasets=[bad-0.4,mediocre-0.0,optimized-0.6,mediocre-1.0,swimmer,hopper,walker2d]",
        ),
        takes="15 minutes (datasets=all 40)",
    ),
    _study(
        "figure-6.10",
        "What LION's Beta distribution of λ does, in the real system: figure 6.10",
        """\
The thesis shows bad-0.2: the more weight the distribution has at its ends, the better are λ = 0
and λ = 1 learned, since networks are drawn to the mean of what they see; 0.1 it takes. Its clone
of the log has -286 there (the one number of the figure that has been handed down).
""",
        subject=("algorithms=[lion]",),
        defaults=("datasets=[bad-0.2]", "variants.lion.beta=[0.1,0.3,1.0,3.0]"),
        takes="5 minutes",
        called=lambda cell: f"Beta({cell.settings['beta']:g}, {cell.settings['beta']:g})",
    ),
    _study(
        "figure-6.11",
        "LION with the mean of its models, or one alone: figure 6.11",
        """\
The thesis: with the bad controller not much changes. With the mediocre one a single model makes
the return fall at a smaller λ than four do. With the optimized one it falls at about λ = 0.5 with
the mean, at about 0.3 with a single model, and only a little with the least reward of four. Which
share of exploration it shows is not handed down.
""",
        subject=("algorithms=[lion]", "variants.lion.aggregation=[minimum,mean,single]"),
        defaults=("datasets=[bad-0.2,mediocre-0.2,optimized-0.2]",),
        takes="12 minutes",
        called=lambda cell: _AGGREGATIONS[cell.settings.get("aggregation", "minimum")],
    ),
    _study(
        "figure-6.12",
        "LION without a model: λ-TD3+BC beside LION, figures 6.12 to 6.14",
        """\
The thesis: on the Industrial Benchmark policies of λ-TD3+BC do "barely" anything else at another
λ (a small `reach`), though some are good; on Hopper and Walker2D they move away from the log with
λ and get worse.
""",
        subject=("algorithms=[lion,lambda_td3_bc]",),
        defaults=(
            "datasets=[bad-0.4,mediocre-0.0,optimized-0.6,mediocre-1.0,swimmer,hopper,walker2d]",
        ),
        takes="30 minutes",
    ),
)
"""Studies of what happens over λ."""
