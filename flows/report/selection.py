"""Judgements of a sweep as a table: one row per policy, with the true return where it is known."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.selection import ESTIMATES
from flows.pipeline.plan import Node, Plan
from flows.pipeline.store import ArtifactStore
from flows.tasks.judging import JUDGEMENT

__all__ = ["judged_policies"]

_COLUMNS: Final = (
    "model",
    "model_error",
    "model_least",
    "fitted_q",
    "fitted_q_error",
    "distance",
    "outside",
    "promised",
)


def judged_policies(plan: Plan, done: Sequence[Node], store: ArtifactStore) -> pd.DataFrame:
    """All judged policies of finished nodes.

    Args:
        plan: Of the sweep.
        done: Its finished nodes.
        store: With their artifacts.

    Returns:
        Columns ``dataset``, ``algorithm`` (of the variant), ``seed``, ``step``, ``proximity`` (NaN
        where it is not taken), all estimates, those of the behaviour policy as ``NAME_usual``, and
        ``true_return``, NaN where there is no evaluation.
    """
    finished = {node.key for node in done}
    parts = []
    for node in done:
        if node.component != "judgement":
            continue
        store.check(node.key, (JUDGEMENT,))
        with np.load(store.path(node.key) / JUDGEMENT) as stored:
            found = {name: stored[name] for name in stored.files}
        policy = node.inputs["policy"]
        shape = found["model"].shape
        steps, proximities = np.broadcast_arrays(
            found["steps"][:, None], found["proximities"][None]
        )
        columns = {
            "dataset": node.tags["dataset"],
            "algorithm": policy.name.split("/", 1)[0],
            "seed": int(node.tags["seed"]),
            "step": steps.ravel(),
            "proximity": proximities.ravel(),
            **{name: found[name].ravel() for name in _COLUMNS},
            **{f"{name}_usual": float(found[f"behaviour/{name}"][0]) for name in ESTIMATES},
            "true_return": np.full(shape, np.nan).ravel(),
        }
        evaluations = [
            other
            for other in plan.dependents(policy.key)
            if other.component == "evaluation" and other.key in finished
        ]
        if evaluations:
            columns["true_return"] = _true_returns(
                evaluations[0], store, found["steps"], found["proximities"]
            ).ravel()
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _true_returns(
    node: Node, store: ArtifactStore, steps: np.ndarray, proximities: np.ndarray
) -> np.ndarray:
    """Mean returns ``[S, G]`` of an evaluation; NaN at proximities that it lacks."""
    store.check(node.key, ("returns.npz",))
    with np.load(store.path(node.key) / "returns.npz") as stored:
        means, at, known = stored["returns"].mean(axis=-1), stored["steps"], stored["lambdas"]
    means = means[np.searchsorted(at, steps)]
    if np.isnan(proximities).all():
        return means
    apart = np.abs(known[None] - proximities[:, None])
    nearest = apart.argmin(axis=1)
    return np.where(apart.min(axis=1) < 1e-6, means[:, nearest], np.nan)
