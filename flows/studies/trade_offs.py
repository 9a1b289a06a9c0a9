"""Thesis table 6.1: how good is the λ, the penalty or the wanted return that a cautious user finds?

The user deploys the most constrained policy, loosens in small steps, and stops at the first drop
(thesis 6.6.1). Figures 6.1 and 6.8 show what there was to be found by it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from components.algorithms import rvs
from components.evaluation.curves import first_drop, shape_of
from components.reporting.panels import Line, Panel
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.finished import Cell, cells, levels, opened, written
from flows.studies.study import Drawn, Study
from flows.tasks.artifacts import config_object

__all__ = ["STUDIES", "TradeOff", "trade_off_table"]

Array = NDArray[np.float64]

_DATASETS: Final = "datasets=[bad-0.4,mediocre-0.0,optimized-0.6]"
_RVS: Final = ("algorithm.rvs.hidden=[256,256]", "algorithm.rvs.updates=1000")
_MOPO: Final = ("algorithm.mopo.updates=300",)
_NAMES: Final = {"lion": "LION", "mopo": "MOPO", "rvs": "RvS"}


@dataclass(frozen=True)
class TradeOff:
    """The policies of an algorithm on a dataset, from constrained to free.

    Attributes:
        dataset: Its name.
        algorithm: Of the algorithm.
        knob: ``[N]`` what is turned: λ, the penalty, or the return that is asked for.
        returns: ``[N]`` means over the seeds.
        deviation: ``[N]`` of the seeds.
        distance: ``[N]`` to the behaviour policy.
    """

    dataset: str
    algorithm: str
    knob: Array
    returns: Array
    deviation: Array
    distance: Array

    @property
    def defined(self) -> Array:
        """The returns, of policies that broke less than any other."""
        return np.where(np.isnan(self.returns), np.nanmin(self.returns) - 1.0, self.returns)


def _trade_offs(plan: Plan, store: ArtifactStore) -> list[TradeOff]:
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells(plan, store):
        whole = "mopo" if cell.algorithm == "mopo" else cell.label
        groups.setdefault((cell.dataset, whole), []).append(cell)
    made = []
    for (dataset, _), group in groups.items():
        algorithm = group[0].algorithm
        if algorithm == "mopo":  # a policy per penalty, the greatest of which constrains most
            own = sorted(group, key=lambda cell: -cell.settings["penalty"])
            knob = np.array([cell.settings["penalty"] for cell in own])
        else:
            [one] = own = group
            knob = one.column("lambda")
        if algorithm == "rvs":
            config = config_object(rvs.Config, own[0].settings)
            _, achieved = rvs.achieved_returns(opened(plan, store, dataset), config)
            knob = achieved.mean() + knob * (achieved.max() - achieved.mean())
        columns = [
            np.concatenate([cell.column(name) for cell in own])
            for name in ("mean", "seed_std", "distance")
        ]
        made.append(TradeOff(dataset, algorithm, knob, *columns))
    return made


@cache
def _thesis() -> pd.DataFrame:
    """Table 6.1, by dataset."""
    file = resources.files("components.reporting").joinpath("thesis", "table_6_1.csv")
    with file.open(encoding="utf-8") as opened_file:
        return pd.read_csv(opened_file).set_index("dataset")


_FINAL: Final = {"lion": "final_lambda", "mopo": "final_lambda", "rvs": "final_return_to_go"}


def trade_off_table(found: Sequence[TradeOff], level: Mapping[str, float]) -> pd.DataFrame:
    """One row per dataset and algorithm, beside the thesis where it has one."""
    rows = []
    for entry in found:
        chosen, tried = first_drop(entry.defined)
        shape, thesis = shape_of(entry.defined), _thesis()
        known = entry.dataset in thesis.index
        rows.append(
            {
                "dataset": entry.dataset,
                "algorithm": _NAMES[entry.algorithm],
                "log": level[entry.dataset],
                "start": entry.returns[0],
                "knob": entry.knob[chosen],
                "final return": entry.returns[chosen],
                "tried": tried,
                "worst tried": np.nanmin(entry.returns[:tried]),
                "best there is": shape.peak,
                "at": entry.knob[shape.at],
                "zigzag": shape.zigzag,
                "thesis knob": _of(thesis, entry, _FINAL[entry.algorithm], known),
                "thesis return": _of(thesis, entry, "return", known),
            }
        )
    return pd.DataFrame(rows)


def _of(thesis: pd.DataFrame, entry: TradeOff, column: str, known: bool) -> float:
    return float(thesis.loc[entry.dataset, f"{entry.algorithm}_{column}"]) if known else math.nan


_SAID: Final = """\
The user starts with the most constrained policy (λ = 0, the largest penalty, the log's mean
return), loosens step by step, and goes back to the last best as soon as a step loses (thesis
6.6.1). `start`, `final return` and `worst tried` are mean returns over the seeds in the real
system, `tried` counts policies that were deployed; `zigzag` is the variation of the whole
curve beyond that of one with a single hump. RvS's knob is the return that it is asked for, in
twenty steps from the mean to the best of the log.

The thesis: the strategy serves LION best, whose curves are smooth; MOPO and RvS go up and down,
so that it stops early. With MOPO there are better policies on bad-0.4 and mediocre-0.0 than LION
has, but nobody finds them.
"""

_AXES: Final = {
    "lion": ("table-6.1-lion", "proximity λ", {}),
    "mopo": ("figure-6.1", "penalty (freer to the right)", {"backwards": True}),
    "rvs": ("figure-6.8", "return asked for", {}),
}


def _draw(plan: Plan, store: ArtifactStore, folder: Path, *, name: str) -> Drawn:
    found, level = _trade_offs(plan, store), levels(plan, store)
    table = trade_off_table(found, level)
    figures: dict[str, tuple[Sequence[Panel], str, Mapping[str, Any]]] = {}
    for algorithm, (file, below, how) in _AXES.items():
        own = [entry for entry in found if entry.algorithm == algorithm]
        if own:
            figures[file] = ([_panel(entry, level) for entry in own], below, how)
    return written(folder, name, table, _SAID, figures)


def _panel(entry: TradeOff, level: Mapping[str, float]) -> Panel:
    order = np.argsort(entry.knob)
    columns = (entry.knob, entry.returns, entry.deviation, entry.distance)
    line = Line(_NAMES[entry.algorithm], *(column[order] for column in columns))
    chosen, _ = first_drop(entry.defined)
    mark = float(entry.knob[chosen]), float(entry.returns[chosen])
    return Panel(entry.dataset, level[entry.dataset], [line], mark)


def _study(name: str, about: str, algorithms: str, takes: str, *further: str) -> Study:
    swept = ("mopo_penalties=sweep",) if "mopo" in algorithms else ()
    return Study(
        name=name,
        about=about,
        subject=(f"algorithms=[{algorithms}]",),
        defaults=(_DATASETS, *swept),
        quick=("profile=quick", *further),
        takes=takes,
        draw=partial(_draw, name=name),
    )


STUDIES: Final = (
    _study(
        "figure-6.1",
        "Discrete MOPO: a policy for each of 26 penalties, figure 6.1",
        "mopo",
        "12 minutes",
        "seeds=[0]",
        *_MOPO,
    ),
    _study(
        "figure-6.8",
        "RvS over the return it is asked for: figure 6.8",
        "rvs",
        "4 minutes",
        "seeds=[0,1]",
        *_RVS,
    ),
    _study(
        "table-6.1",
        "Stop at the first drop: what a user finds with LION, discrete MOPO and RvS, table 6.1",
        "lion,mopo,rvs",
        "20 minutes",
        "seeds=[0]",
        *_RVS,
        *_MOPO,
    ),
)
"""Studies of what a user finds by turning a knob."""
