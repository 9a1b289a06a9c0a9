"""A safe search for the proximity (thesis 7.2) beside the stop at the first drop (6.6.1).

Searched are the systems that stored evaluations of LION make: every policy of the pool is one, with
the returns of the real system at each proximity.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.statistics import pooled_snapshots
from components.core.arrays import load_arrays
from components.core.files import write_text
from components.core.random_streams import lane_generator, lane_key
from components.evaluation.flights import STRATEGIES, Flights, MeasuredSystem, compare
from components.reporting.ranking import markdown
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.sixteen import SIXTEEN
from flows.studies.study import Drawn, Study

__all__ = ["STUDY", "autopilot_table"]

_READ: Final = """\
All in returns of the real system, means over policies and five searches each. `clone` is λ = 0,
`best` the best λ of the grid, which nobody knows beforehand. Of each strategy: the return at the λ
that it ends with, the worst step on the way (the least difference of a mean return from that of the
same policy's clone, in any search), trajectories used, and in how many of the searches
a λ was tried that returns less than the clone by more than a tenth of its size. The autopilot may
use 50 trajectories, assumes that the return falls by at most four times the clone's size per unit
of λ, and may fail in one search of ten; `first drop` tries each λ with one trajectory, `first drop
of 10` with ten, as the thesis evaluates.
"""


def autopilot_table(logs: Mapping[str, Sequence[MeasuredSystem]]) -> pd.DataFrame:
    """One row per log, and their mean.

    Args:
        logs: By name, the policies that learned from it.
    """
    rows = []
    for name, systems in logs.items():
        rng = lane_generator(lane_key("autopilot", name))
        rows.append({"dataset": name, **_row([compare(system, rng) for system in systems])})
    table = pd.DataFrame(rows)
    if len(rows) > 1:
        table.loc[len(rows)] = {"dataset": "mean", **table.mean(numeric_only=True)}
    return table


def _row(found: Sequence[Flights]) -> dict[str, float]:
    row = {
        "clone": float(np.mean([one.clone for one in found])),
        "best": float(np.mean([one.best for one in found])),
    }
    for name in STRATEGIES:
        flights = [(one.clone, flight) for one in found for flight in one.flights[name]]
        row |= {
            f"{name}: λ": float(np.mean([flight.proximity for _, flight in flights])),
            f"{name}: return": float(np.mean([clone + flight.gain for clone, flight in flights])),
            f"{name}: worst": float(min(flight.worst for _, flight in flights)),
            f"{name}: trajectories": float(np.mean([flight.trajectories for _, flight in flights])),
            f"{name}: below": float(np.mean([one.share_below(name) for one in found])),
        }
    return row


def _systems(cell: Node, store: ArtifactStore) -> Iterable[MeasuredSystem]:
    """The policies of a cell's pool."""
    for evaluation in cell.inputs.values():
        stored = load_arrays(store.path(evaluation.key) / "returns.npz")
        last = pooled_snapshots(len(stored["returns"]), cell.config["pool_fraction"])
        for returns in stored["returns"][-last:]:
            if np.isfinite(returns).all():
                yield MeasuredSystem(stored["lambdas"], returns)


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    """The table of a finished plan."""
    cells = plan.by_component()["aggregation"]
    logs = {cell.tags["dataset"]: list(_systems(cell, store)) for cell in cells}
    table = autopilot_table({name: systems for name, systems in logs.items() if systems})
    digits = {
        name: 2 if name.endswith(("λ", "below")) else 1 for name in table.columns[1:].tolist()
    }
    text = f"{markdown(table, digits)}\n{_READ}"
    files = [folder / "autopilot.csv", folder / "autopilot.md"]
    write_text(files[0], table.to_csv(index=False, lineterminator="\n"))
    write_text(files[1], text)
    return Drawn(files, text)


STUDY: Final = Study(
    name="autopilot",
    about="a safe search for λ beside the stop at the first drop (thesis 7.2)",
    subject=("algorithms=[lion]",),
    defaults=(SIXTEEN, "seeds=[0,1]"),
    takes="hours; with profile=quick minutes",
    draw=_draw,
)
