"""The sanity check of thesis 6.5: what LION does in the 2-D world, proximity by proximity.

Figures 6.3 and 6.4 as maps of arrows over the plane, a film over the proximity, and in numbers what
the thesis reads off its figure: where agents end that follow the policy from every place.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from components.core.files import write_text
from components.data.controllers.world import to_nearest
from components.data.dataset import OfflineDataset
from components.environments.world.plane import CENTRE, SIDE, Plane, reward_at
from components.policies.policy import Policy
from components.reporting.figures import save_figure
from components.reporting.policy_maps import (
    PlaneMap,
    log_figure,
    panels_figure,
    picture,
    save_reduced,
)
from components.reporting.ranking import markdown
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.studies.study import Drawn, Study
from flows.video import video

__all__ = ["STUDY"]

Array = NDArray[np.float64]

_PLACES: Final = 15  # arrows along a side
_PIXELS: Final = 101  # of the reward along a side
_SHOTS: Final = 51  # pictures of the film, from proximity 0 to 1
_PER_SECOND: Final = 8.0
_LOGGED: Final = 2500  # positions shown, evenly taken from the log

_THESIS: Final = """\
The thesis reads off its figure 6.4: not much changes up to λ = 0.3; then the goal in the top right
is given up, which "finishes around the λ = 0.7 / λ = 0.75 mark"; after that the destination moves
north until at λ = 1 it lies "straight on top of" the centre of the reward.

`bottom left`, `top right` and `centre` are the shares of 225 starts, even over the plane, that end
nearest to these points after one episode; `to the centre` is the mean distance of the ends to the
centre; all in the real system, as means over the seeds.
"""


def _grid(points: int) -> Array:
    """Places `[points^2, 2]`, even over the square, row by row from y = 0 up."""
    along = np.linspace(0.0, SIDE, points)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def _act(policy: Policy, positions: Array, proximity: float) -> Array:
    """Actions `[N, 2]` of a single policy in positions `[N, 2]`."""
    seen = torch.from_numpy(positions[None, :, None]).float()
    chosen = policy.act(seen, torch.full((1, len(positions)), proximity))
    return chosen[0].numpy().astype(np.float64)


def _ends(policy: Policy, starts: Array, proximity: float, steps: int) -> Array:
    """Where agents `[N, 2]` are that have followed a policy for some steps."""
    plane = Plane(len(starts))
    x, y = starts.T
    positions = plane.reset(np.random.default_rng(0), start={"x": x, "y": y})
    for _ in range(steps):
        positions, _ = plane.step(_act(policy, positions, proximity))
    return positions


def _table(
    policies: list[Policy], summary: dict[str, Any], starts: Array, points: Array, steps: int
) -> pd.DataFrame:
    """One row per proximity of the evaluation, over all seeds; `points` are goals and centre."""
    rows = []
    for point in summary["points"]:
        proximity = point["lambda"]
        ends = np.concatenate([_ends(p, starts, proximity, steps) for p in policies])
        distances = np.linalg.norm(ends[:, None] - points, axis=-1)
        shares = np.bincount(distances.argmin(axis=1), minlength=len(points)) / len(ends)
        rows.append(
            {
                "λ": proximity,
                "return": point["mean"],
                "distance": point["distance"],
                "bottom left": shares[0],
                "top right": shares[1],
                "centre": shares[2],
                "to the centre": distances[:, 2].mean(),
            }
        )
    return pd.DataFrame(rows)


def _last(store: ArtifactStore, node: Node) -> Policy:
    """The last snapshot of a stored policy."""
    policy = Policy.load(store.path(node.key) / "policy")
    return policy.select(slice(policy.lanes - 1, policy.lanes), policy.card)


def _draw(plan: Plan, store: ArtifactStore, folder: Path) -> Drawn:
    """Figures 6.3 and 6.4, the film and the table of a finished plan."""
    nodes = plan.by_component()
    [data], [aggregation] = nodes["data_generation"], nodes["aggregation"]
    dataset = OfflineDataset.open(store.path(data.key) / "dataset")
    goals = np.array(data.config["spec"]["goals"])
    policies = [_last(store, node) for node in nodes["policy_training"]]
    places, steps = _grid(_PLACES), dataset.card.steps
    plane = PlaneMap(
        side=SIDE,
        places=places,
        rewards=reward_at(_grid(_PIXELS)).reshape(_PIXELS, _PIXELS),
        goals=goals,
        centre=CENTRE,
    )
    summary = store.read_json(aggregation.key, "summary.json")
    table = _table(policies, summary, places, np.stack([*goals, CENTRE]), steps)
    names = ("log.png", "panels.png", "proximity.gif", "world.csv", "world.md")
    files = [folder / name for name in names]
    logged = np.asarray(dataset.frames[:: max(1, len(dataset.frames) // _LOGGED)], np.float64)
    save_figure(log_figure(plane, to_nearest(places, goals), logged), files[0])
    shown = policies[0]
    maps = {p: (_act(shown, places, p), _ends(shown, places, p, steps)) for p in table["λ"]}
    save_reduced(panels_figure(plane, maps), files[1])
    with video(files[2], _PER_SECOND) as film:
        for proximity in np.linspace(0.0, 1.0, _SHOTS):
            ends = _ends(shown, places, proximity, steps)
            film(picture(plane, proximity, _act(shown, places, proximity), ends))
    digits = {name: 2 for name in table.columns}
    text = f"{markdown(table, digits)}\n{_THESIS}"
    write_text(files[3], table.to_csv(index=False, lineterminator="\n"))
    write_text(files[4], text)
    return Drawn(files, text)


STUDY: Final = Study(
    name="world",
    about="LION in the 2-D world at every λ: figures 6.3 and 6.4, and a film",
    subject=("datasets=[world]", "algorithms=[lion]"),
    takes="3 minutes",
    defaults=("seeds=[0,1]", "evaluation.horizon=25", "evaluation.trajectories=50"),
    draw=_draw,
)
