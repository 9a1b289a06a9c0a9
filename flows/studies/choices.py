"""Thesis figure 6.9: η and the Beta distribution of λ, chosen without an environment.

What a policy does at λ = 0 needs no system to be measured: it has to do what the log does. Models
and policies learn from the first episodes of a log, the last ones tell how far the policies'
actions at λ = 0 are from the logged ones. Nothing is evaluated in the real system.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd

from components.data.dataset import OfflineDataset
from components.judging.imitation import imitation_errors
from components.policies.policy import Policy
from components.reporting.panels import Line, Panel
from flows.configuration.settings import Settings
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.planning.judging import part_node
from flows.studies.finished import written
from flows.studies.study import Drawn, Study

__all__ = ["STUDY"]

_NAME: Final = "figure-6.9"
_SAID: Final = """\
`error` is the mean squared distance per action entry between what a policy does at λ = 0 and what
the log did, in the {held_out:.0%} of its episodes that neither models nor policies have seen;
`clone` is that of the behaviour model that LION stays close to. Both are means over the seeds. No
real system takes part.

The thesis: any η but 0 clones about as well, so it stays with 0.1. The less weight the
distribution has at its ends, the worse is the clone, so it takes Beta(0.1, 0.1); smaller ones
"may result in numerical instabilities".
"""


def _plan(settings: Settings) -> Plan:
    """Policies that learn from a part of each log, and the other part, and nothing else."""
    judging = settings.judging.model_copy(update={"policies": "all"})
    whole = benchmark_plan(settings.model_copy(update={"judging": judging})).by_component()
    parts = [part_node(settings, data, "judge") for data in whole["data_generation"]]
    return Plan([*whole["policy_training"], *parts])


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    nodes = plan.by_component()
    held = {
        node.tags["dataset"]: OfflineDataset.open(store.path(node.key) / "dataset")
        for node in nodes["data_split"]
        if node.config["part"] == "judge"
    }
    rows: list[dict[str, Any]] = []
    for node in nodes["policy_training"]:
        dataset, settings = node.tags["dataset"], node.config["settings"]
        clone = Policy.load(store.path(node.inputs["behaviour_policy"].key) / "model")
        policies = Policy.load(store.path(node.key) / "policy")
        rows.append(
            {
                "dataset": dataset,
                "eta": settings["eta"],
                "beta": settings["beta"],
                "error": imitation_errors(policies, held[dataset])[-1],
                "clone": imitation_errors(clone, held[dataset])[-1],
            }
        )
    by_choice = pd.DataFrame(rows).groupby(["dataset", "eta", "beta"])
    table = by_choice["error"].agg(error="mean", deviation=lambda e: e.std(ddof=0)).reset_index()
    table["clone"] = by_choice["clone"].mean().to_numpy()
    how = {
        "beside": "squared distance to\nheld-out actions",
        "level": "behaviour model",
        "logarithmic": True,
    }
    figures = {
        f"{_NAME}-{setting}": (_panels(table, setting, other), label, how)
        for setting, other, label in (
            ("eta", "beta", "η"),
            ("beta", "eta", "parameter of the Beta distribution"),
        )
    }
    said = _SAID.format(held_out=nodes["data_split"][0].config["held_out"])
    return written(folder, _NAME, table, said, figures)


def _panels(table: pd.DataFrame, setting: str, other: str) -> Sequence[Panel]:
    """Errors over a setting, where the other one has the value that most policies have."""
    panels = []
    for dataset, own in table.groupby("dataset", sort=False):
        shown = own[own[other] == own[other].mode()[0]].sort_values(setting)
        columns = (shown[name].to_numpy() for name in (setting, "error", "deviation"))
        line = Line("policies at λ = 0", *columns)
        panels.append(Panel(str(dataset), float(own["clone"].iloc[0]), [line]))
    return panels


STUDY: Final = Study(
    name=_NAME,
    about="η and the Beta distribution of λ chosen from the log alone: figure 6.9",
    subject=("algorithms=[lion]",),
    defaults=(
        "datasets=[bad-0.2,mediocre-0.2,optimized-0.2]",
        "variants.lion.eta=[0.0,0.01,0.1,1.0]",
        "variants.lion.beta=[0.1,0.3,1.0,3.0]",
    ),
    quick=("profile=quick", "seeds=[0]"),
    takes="20 minutes",
    plan=_plan,
    draw=_draw,
)
"""The study of what can be chosen offline."""
