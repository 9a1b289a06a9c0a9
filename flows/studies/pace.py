"""How fast WSBC's swarm may be: velocity limits over the iterations, beside thesis table 5.4.

The thesis names no limit. Without one the swarm is through in 10 to 20 iterations and then searches
for what the models promise where nothing was logged.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from components.reporting.panels import Line, Panel
from components.reporting.thesis_numbers import thesis_numbers
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.finished import cells, levels, promised, real_returns, written
from flows.studies.sixteen import SIXTEEN
from flows.studies.study import Drawn, Study

__all__ = ["STUDY"]

_NAME: Final = "pace"
_READ: Final = """\
`limit` in halves of the box, for one iteration. Mean returns in the real system of the policy after
a quarter, half and all of the iterations, and of the pool; `promised` is what the ensemble expects
of the best particle at the end. The thesis's number is a 10th percentile, after all its iterations.
"""


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    level, thesis = levels(plan, store), thesis_numbers()
    lines: dict[str, list[Line]] = {}
    rows: list[dict[str, Any]] = []
    for cell in cells(plan, store):
        steps, returns = real_returns(cell, store)
        mean = returns[:, :, 0].mean(axis=0)
        limit, log = cell.settings["velocity_limit"], level[cell.dataset]
        # Returns that are not counted as the log's are not counted as the thesis's either.
        theirs = np.nan if np.isnan(log) else thesis.get((cell.dataset, "wsbc"), (np.nan,))[0]
        lines.setdefault(cell.dataset, []).append(Line(f"limit {limit:g}", steps, mean))
        quarter, half = (mean[max(0, len(mean) // part - 1)] for part in (4, 2))
        rows.append(
            {
                "dataset": cell.dataset,
                "limit": f"{limit:g}",
                "log": log,
                "quarter": quarter,
                "half": half,
                "end": mean[-1],
                "pool": float(cell.returns[0]),
                "promised": promised(cell, store)[1][-1],
                "thesis": theirs,
            }
        )
    panels = [Panel(dataset, level[dataset], own) for dataset, own in lines.items()]
    figure = (panels, "iterations of the swarm", {})
    return written(folder, _NAME, pd.DataFrame(rows), _READ, {_NAME: figure})


STUDY: Final = Study(
    name=_NAME,
    about="WSBC with several velocity limits over its iterations",
    subject=("algorithms=[wsbc]",),
    defaults=(SIXTEEN, "seeds=[0]", "variants.wsbc.velocity_limit=[1,0.1]"),
    quick=(
        "profile=quick",
        "algorithm.wsbc.updates=100",
        "algorithm.wsbc.particles=24",
        "algorithm.wsbc.neighbourhood=5",
        "algorithm.wsbc.starts=24",
    ),
    takes="20 minutes",
    draw=_draw,
)
"""The study of WSBC's velocity limit."""
