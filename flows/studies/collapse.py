"""Thesis figure 2.4: search in models alone, without any constraint, fails where the log is narrow.

The policies of `model_based` maximise what the ensemble promises. What they really earn, in the
course of the training, stands beside it and beside the log.
"""

from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from components.reporting.panels import Line, Panel
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.finished import cells, levels, promised, real_returns, written
from flows.studies.study import Drawn, Study

__all__ = ["STUDY"]

_NAME: Final = "figure-2.4"

_SAID: Final = """\
`first`, `best` and `last` are the returns of the first, the best and the last of the stored
policies of a training in the real system, `promised` is what the ensemble promised at the end,
from starts in the log; all are means over the seeds. The thesis shows policies that end below the
generating one on the sets "which exhibit little to no exploration"; which of them it shows is not
handed down, so these are those with 0 % and 20 %.
"""


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    level = levels(plan, store)
    drawn, rows = [], []
    for cell in cells(plan, store):
        steps, returns = real_returns(cell, store)
        returns = returns[:, :, 0]
        mean = returns.mean(axis=0)
        spread = returns.std(axis=0, ddof=1) if len(returns) > 1 else np.zeros_like(mean)
        when, promise = promised(cell, store)
        lines = [
            Line("in the real system", steps, mean, spread),
            Line("promised by the ensemble", when, promise),
        ]
        log = level[cell.dataset]
        drawn.append(Panel(cell.dataset, log, lines))
        last = float(mean[-1])
        rows.append(
            {
                "dataset": cell.dataset,
                "log": log,
                "first": mean[0],
                "best": mean.max(),
                "last": last,
                "promised": promise[-1],
                "ends": "above the log" if last > log else "below the log",
            }
        )
    figure = (drawn, "updates", {})
    return written(folder, _NAME, pd.DataFrame(rows), _SAID, {_NAME: figure})


STUDY: Final = Study(
    name=_NAME,
    about="Search in the models without any constraint, beside the log: figure 2.4",
    subject=("algorithms=[model_based]",),
    defaults=("datasets=[bad-0.0,mediocre-0.0,optimized-0.0,bad-0.2,mediocre-0.2,optimized-0.2]",),
    quick=("profile=quick", "seeds=[0,1]"),
    takes="8 minutes",
    draw=_draw,
)
"""The study of what is exploited."""
