"""Thesis figure 2.3: DDPG that may try, and DDPG that has to learn from what another has tried.

The same learner, with the same transitions and as many updates, learns online, from a replay memory
that grows with its own attempts, or offline, from all of it at once. A second offline learner has
episodes of the best online policy alone.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from components.core.arrays import load_arrays
from components.data.dataset import OfflineDataset
from components.reporting.panels import Line, Panel
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.planning.online import LOGS, online_plan
from flows.studies.finished import written
from flows.studies.study import Drawn, Study

__all__ = ["STUDY"]

Array = NDArray[np.float64]

_NAME: Final = "figure-2.3"
_LOGS: Final = {"replay": "the online learner's own attempts", "final": "its best policy alone"}
_SAID: Final = """\
Undiscounted returns of whole episodes without noise, means over the seeds. `log` is the mean
return of its episodes; `best` and `last` are those of the evaluations during a training. The
offline learner has the networks, rates and batches of the online one, and makes as many updates;
it sees frames standardised, which the online one, that has no log to take a scale from, does not.

The thesis (after Fujimoto et al., 2019): offline learners are "unable to remotely replicate the
performance" of the online one, though "some of them are trained on the exact same data". Its
curves are not handed down as numbers.
"""


def _online(node: Node, store: ArtifactStore) -> tuple[Array, Array]:
    """Updates and returns of an online training."""
    curves = load_arrays(store.path(node.key) / "curves.npz")
    steps, returns = (curves[f"evaluation/return/{part}"] for part in ("step", "value"))
    return steps - node.config["training"]["random_steps"], returns


def _offline(node: Node, store: ArtifactStore) -> tuple[Array, Array]:
    stored = load_arrays(store.path(node.key) / "returns.npz")
    return stored["steps"], stored["returns"].mean(axis=(1, 2))


def _line(name: str, curves: list[tuple[Array, Array]]) -> Line:
    returns = np.stack([values for _, values in curves])
    spread = returns.std(axis=0, ddof=1) if len(returns) > 1 else np.zeros(returns.shape[1])
    return Line(name, curves[0][0], returns.mean(axis=0), spread)


def _episode_return(log: OfflineDataset) -> float:
    """Mean undiscounted return of the episodes of a log that are whole; else of all."""
    sums = np.add.reduceat(log.rewards.astype(np.float64), log.episode_starts[:-1])
    whole = sums[:-1] if len(sums) > 1 else sums  # the last one is cut
    return float(whole.mean())


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    evaluations = plan.by_component()["evaluation"]
    panels, rows = [], []
    for dataset in dict.fromkeys(node.tags["dataset"] for node in evaluations):
        for log in LOGS:
            own = [n for n in evaluations if (n.tags["dataset"], n.tags["log"]) == (dataset, log)]
            logs = [node.inputs["policy"].inputs["dataset"] for node in own]
            online = _line("online", [_online(node.inputs["online"], store) for node in logs])
            offline = _line("offline", [_offline(node, store) for node in own])
            level = np.mean(
                [_episode_return(OfflineDataset.open(store.path(n.key) / "dataset")) for n in logs]
            )
            panels.append(Panel(f"{dataset}: {_LOGS[log]}", float(level), [online, offline]))
            row: dict[str, Any] = {"robot": dataset, "offline on": _LOGS[log], "log": level}
            for line in (online, offline):
                row |= {f"{line.name} best": line.mean.max(), f"{line.name} last": line.mean[-1]}
            rows.append(row)
    table = pd.DataFrame(rows)
    how = {"beside": "return of an episode", "level": "episodes of the log"}
    return written(folder, _NAME, table, _SAID, {_NAME: (panels, "updates", how)})


STUDY: Final = Study(
    name=_NAME,
    about="DDPG on a robot, online and offline on what it logged: figure 2.3",
    subject=("algorithms=[ddpg]",),
    defaults=("datasets=[swimmer]",),
    quick=(
        "profile=quick",
        "seeds=[0,1]",
        "experts.training.steps=30000",
        "experts.training.random_steps=2000",
        "experts.training.evaluate_every=1500",
        "experts.training.episodes=3",
        "experts.training.hidden=[64,64]",
    ),
    takes="6 minutes",
    plan=online_plan,
    draw=_draw,
)
"""The study of learning without trying."""
