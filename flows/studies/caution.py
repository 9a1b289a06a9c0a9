"""What it costs and saves to charge LION and WSBC for leaving the log's support (thesis 7.2).

On narrow logs policies at the far end lose in reality what the ensemble promised. The same policies
trained with a price, see :mod:`components.algorithms.parts.caution`, stand beside those without.
"""

from pathlib import Path
from typing import Any, Final

import pandas as pd

from components.algorithms.parts.caution import MEASURES
from components.reporting.panels import Line
from components.reporting.ranking import markdown
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.finished import Cell, cells, decimals, levels, panels, written
from flows.studies.sixteen import SIXTEEN
from flows.studies.study import Drawn, Study

__all__ = ["STUDY"]

_NAME: Final = "caution"
_NAMES: Final = {"lion": "LION", "wsbc": "WSBC"}
_READ: Final = """\
Means of the pooled policies' returns in the real system. `price`: the value of `caution`, in mean
returns of the log, and what it is charged by; the thesis knows none. `saved`: by how much the
price improved the return; what it cost is negative. `below`: on how many of
the `logs` whose returns are counted alike policies end below their log.
"""


def _by_log(found: list[Cell], level: dict[str, float]) -> pd.DataFrame:
    """One row per log, policy and price.

    Args:
        found: Cells of LION and WSBC, each also without a price.
        level: By dataset the mean return of its log.
    """
    free = {(c.dataset, c.algorithm): c for c in found if not c.settings.get("caution")}
    rows: list[dict[str, Any]] = []
    for cell in found:
        if not cell.settings.get("caution"):
            continue
        without = free[cell.dataset, cell.algorithm].returns
        price = f"{cell.settings['caution']:g}, {cell.settings.get('caution_by', MEASURES[0])}"
        for point, before, after in zip(cell.points, without, cell.returns, strict=True):
            at = "" if point["lambda"] is None else f", λ = {point['lambda']:g}"
            rows.append(
                {
                    "dataset": cell.dataset,
                    "policy": f"{_NAMES[cell.algorithm]}{at}",
                    "price": price,
                    "log": level[cell.dataset],
                    "without": before,
                    "with": after,
                    "saved": after - before,
                }
            )
    return pd.DataFrame(rows)


def _over_logs(table: pd.DataFrame) -> pd.DataFrame:
    """One row per policy and price: means over the logs, and on how many it ends below its log."""
    rows = []
    for (policy, price), own in table.groupby(["policy", "price"], sort=False):
        known = own.dropna(subset=["log"])
        rows.append(
            {
                "policy": policy,
                "price": price,
                "without": own["without"].mean(),
                "with": own["with"].mean(),
                "most saved": own["saved"].max(),
                "most cost": own["saved"].min(),
                "logs": len(known),
                "below without": (known["without"] < known["log"]).sum(),
                "below with": (known["with"] < known["log"]).sum(),
            }
        )
    return pd.DataFrame(rows)


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    found, level = cells(plan, store), levels(plan, store)
    table = _by_log(found, level)
    means = _over_logs(table)
    lines: dict[str, list[Line]] = {}
    for cell in found:
        if cell.points[0]["lambda"] is not None:
            price = cell.settings.get("caution")
            name = f"LION, caution {price:g}" if price else "LION"
            lines.setdefault(cell.dataset, []).append(cell.line(name))
    said = f"Over the logs:\n\n{markdown(means, decimals(means))}\n{_READ}"
    figure = (panels(lines, level), "proximity λ", {})
    return written(folder, _NAME, table, said, {_NAME: figure})


STUDY: Final = Study(
    name=_NAME,
    about="LION and WSBC with and without a price on leaving the log's support",
    subject=("algorithms=[lion,wsbc]",),
    defaults=(
        SIXTEEN,
        "seeds=[0]",
        "variants.lion.caution=[null,0.5]",
        "variants.wsbc.caution=[null,0.5]",
    ),
    quick=("profile=quick",),
    takes="an hour",
    draw=_draw,
)
"""The study of a remedy for exploited models."""
