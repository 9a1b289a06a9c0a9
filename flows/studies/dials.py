"""Every policy with a dial: curves over the trade-off by peak, area and smoothness (thesis 7.2).

LION, lambda-TD3+BC and RvS take the proximity at run time; MOPO's dial is a penalty, for each value
of which a policy is trained (thesis 6.3), the most cautious first.
"""

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from components.core.files import write_text
from components.evaluation.curves import first_drop, shape_of
from components.reporting.figures import save_figure
from components.reporting.ranking import markdown
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.sixteen import SIXTEEN
from flows.studies.study import Drawn, Study

__all__ = ["STUDY", "dials_table"]

Curve = tuple[list[float], list[float]]
"""Settings, the most cautious first, and mean returns."""

_COLUMNS: Final = 4
_READ: Final = """\
Mean returns of the real system. `first` is the most cautious setting, `peak` the best one, `area`
the mean over the dial, what an operator gets who turns it blindly, `greatest fall` that from one
setting to the next, `zigzag` the total variation beyond that of a curve with a single hump: 0 where
the best setting can be climbed to. `first drop` is what the strategy of thesis 6.6.1 ends with.
"""


def dials_table(curves: Mapping[tuple[str, str], Curve]) -> pd.DataFrame:
    """One row per log and algorithm.

    Args:
        curves: By (dataset, algorithm).
    """
    rows = []
    for (dataset, algorithm), (settings, returns) in curves.items():
        shape = shape_of(returns, settings)
        rows.append(
            {
                "dataset": dataset,
                "algorithm": algorithm,
                "first": returns[0],
                "peak": shape.peak,
                "at": settings[shape.at],
                "area": shape.area,
                "greatest fall": shape.greatest_fall,
                "zigzag": shape.zigzag,
                "first drop": returns[first_drop(returns)[0]],
            }
        )
    return pd.DataFrame(rows)


def _curves(plan: Plan, store: ArtifactStore) -> dict[tuple[str, str], Curve]:
    cells = plan.by_component()["aggregation"]

    def of(cell: Node) -> tuple[str, str]:
        return cell.tags["dataset"], cell.tags["algorithm"]

    curves = {}
    for key, own in groupby(sorted(cells, key=of), key=of):
        points: list[tuple[float, float]] = []
        for cell in own:
            summary: dict[str, Any] = store.read_json(cell.key, "summary.json")
            for point in summary["points"]:
                place = point["lambda"]
                # A large penalty is cautious, a small proximity is.
                points.append(
                    (-float(cell.tags["penalty"]) if place is None else place, point["mean"])
                )
        points.sort()
        returns = [value for _, value in points]
        if len(points) > 1 and np.isfinite(returns).all():
            curves[key] = ([abs(place) for place, _ in points], returns)
    return curves


def dials_figure(curves: Mapping[tuple[str, str], Curve]) -> Figure:
    """A panel per log, a curve per algorithm over the share of its dial."""
    datasets = list(dict.fromkeys(dataset for dataset, _ in curves))
    algorithms = list(dict.fromkeys(algorithm for _, algorithm in curves))
    lines = -(-len(datasets) // _COLUMNS)
    figure = Figure(figsize=(3.0 * _COLUMNS, 2.4 * lines), layout="constrained")
    panels = figure.subplots(lines, _COLUMNS, squeeze=False).flatten()
    for axes in panels[len(datasets) :]:
        axes.set_visible(False)
    for axes, dataset in zip(panels, datasets, strict=False):
        for number, algorithm in enumerate(algorithms):
            if (dataset, algorithm) in curves:
                settings, returns = (np.array(part) for part in curves[dataset, algorithm])
                share = (settings - settings[0]) / (settings[-1] - settings[0])
                axes.plot(share, returns, color=f"C{number}", label=algorithm)
        axes.set_title(dataset, fontsize="medium")
        axes.grid(alpha=0.25, linewidth=0.5)
    panels[0].legend(fontsize="small")
    figure.supxlabel("from the most cautious setting to the freest")
    figure.supylabel("mean discounted return")
    return figure


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    """Figure and tables of a finished plan."""
    curves = _curves(plan, store)
    table = dials_table(curves)
    number = table.columns[2:].tolist()
    digits = dict.fromkeys(number, 1) | {"at": 2}
    means = table.groupby("algorithm", sort=False)[number].mean().reset_index()
    text = f"{markdown(table, digits)}\nMeans over the logs:\n\n{markdown(means, digits)}\n{_READ}"
    files = [folder / name for name in ("dials.png", "dials.csv", "dials.md")]
    save_figure(dials_figure(curves), files[0])
    write_text(files[1], table.to_csv(index=False, lineterminator="\n"))
    write_text(files[2], text)
    return Drawn(files, text)


STUDY: Final = Study(
    name="dials",
    about="LION, lambda-TD3+BC, RvS and MOPO over their trade-offs: peak, area, smoothness",
    subject=("algorithms=[lion,lambda_td3_bc,rvs,mopo]",),
    defaults=(SIXTEEN, "seeds=[0,1]", "mopo_penalties=[0,0.5,1,1.5,2,2.5]"),
    takes="days; with profile=quick hours",
    draw=_draw,
)
