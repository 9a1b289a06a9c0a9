"""Judgements of a sweep as a table: one row per policy, with the true return where it is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from components.aggregation.selection import (
    DEFAULT_SCORE,
    ESTIMATES,
    SCORES,
    chosen_blind,
    scored,
)
from components.core.files import write_text
from components.data.card import DatasetCard
from components.judging.judgement import Judgement
from components.reporting.ranking import markdown
from components.reporting.selection import judge_table, selection_markdown, selection_table
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.report.leads import expected_frames
from flows.tasks.judging import JUDGEMENT

__all__ = [
    "NOTHING_JUDGED",
    "QUALITIES",
    "Selection",
    "doubts",
    "judged_policies",
    "write_selection",
]

QUALITIES: Final = {
    "spearman": 2,
    "regret_1": 1,
    "regret_5": 1,
    "relative_regret": 2,
    "caught": 2,
    "exploits_caught": 2,
    "cleared": 2,
}
"""Columns of the table of judges that are printed, and their decimals."""
_USUAL: Final = (*ESTIMATES, "model_error", "fitted_q_error")
"""What is kept of the behaviour policy's judgement."""


@dataclass(frozen=True)
class Selection:
    """What was written about judged policies.

    Attributes:
        files: Tables as CSV.
        lines: What to print.
        datasets: Names of those whose policies were judged.
    """

    files: Sequence[Path] = ()
    lines: Sequence[str] = ()
    datasets: frozenset[str] = frozenset()


NOTHING_JUDGED: Final = Selection()


def write_selection(
    folder: Path,
    done: Sequence[Node],
    store: ArtifactStore,
    cards: Sequence[DatasetCard],
) -> Selection:
    """Write `judgements.csv` and `selection.csv`.

    Where it is known where policies lead, also `frames.csv`, and where true returns are known,
    `judges.csv`.

    Args:
        folder: Of the report.
        done: The finished nodes of a sweep.
        store: With their artifacts.
        cards: Of the datasets.

    Raises:
        DamagedFileError: A judgement is missing or damaged.
    """
    policies = judged_policies(done, store)
    if policies.empty:
        return NOTHING_JUDGED
    policies = scored(policies)
    table = selection_table(policies, DEFAULT_SCORE)
    written = {"judgements": policies, "selection": table}
    frames = expected_frames(done, store)
    if not frames.empty:
        written["frames"] = frames
    lines = [
        "",
        f"Judged from the log alone, best first by the score {DEFAULT_SCORE}: the gain over the "
        "behaviour policy that the ensemble expects (the critics where there is none), less a "
        "price for steps outside of the log (docs/judging.md).",
        "",
        *selection_markdown(table).splitlines(),
        "",
        f"All {len(table)} rows and all scores are in selection.csv.",
        *doubts(policies, cards),
    ]
    judges = judge_table(
        policies,
        {card.name: card.first_window_return_mean for card in cards},
        {card.name: card.controller for card in cards},
    )
    if not judges.empty:
        written["judges"] = judges
        means = judges.groupby("score", sort=False)[list(QUALITIES)].mean().loc[list(SCORES)]
        lines += [
            "",
            f"How well judges rank, mean of {judges['dataset'].nunique()} datasets:",
            "",
            *markdown(means.reset_index(), QUALITIES).splitlines(),
            *_blind(judges),
        ]
    files = [folder / f"{name}.csv" for name in written]
    for path, content in zip(files, written.values(), strict=True):
        write_text(path, content.to_csv(index=False, lineterminator="\n"))
    return Selection(files, lines, frozenset(policies["dataset"]))


def doubts(policies: pd.DataFrame, cards: Sequence[DatasetCard]) -> list[str]:
    """A sentence for every log whose own returns do not hold what judges give its behaviour policy.

    The clone of a controller, without its exploration, may be somewhat better than its log.
    """
    found = []
    for card in cards:
        own = policies[policies["dataset"] == card.name]
        low, high = card.first_window_return_min, card.first_window_return_max
        usual = [
            f"{float(own[name].iloc[0]):.1f} by {words}"
            for name, words in (("model_usual", "the ensemble"), ("fitted_q_usual", "the critics"))
            if len(own) and not np.isnan(own[name].iloc[0]) and not low <= own[name].iloc[0] <= high
        ]
        if usual:
            found.append(
                f"{card.name}: its behaviour policy is worth {' and '.join(usual)}, but the log's "
                f"own returns lie between {low:.1f} and {high:.1f} (mean "
                f"{card.first_window_return_mean:.1f}): do not trust the gains there."
            )
    return found


def _blind(judges: pd.DataFrame) -> list[str]:
    """What would have been chosen for each controller's logs by those of the others."""
    groups = list(judges["group"].unique())
    if len(groups) < 2:
        return []
    regrets = judges.groupby(["group", "score"])["relative_regret"].mean()
    found = [
        f"{group}: {score} ({regrets[group, score]:.2f})"
        for group, score in chosen_blind(judges, groups).items()
    ]
    said = "Of least relative regret on the logs of all other controllers (and the regret here): "
    return ["", f"{said}{'; '.join(found)}."]


def judged_policies(done: Sequence[Node], store: ArtifactStore) -> pd.DataFrame:
    """All judged policies of finished nodes.

    Args:
        done: The finished nodes of a sweep.
        store: With their artifacts.

    Returns:
        Columns ``dataset``, ``algorithm`` (of the variant), ``seed``, ``step``, ``proximity`` (NaN
        where it is not taken), all estimates, those of the behaviour policy as ``NAME_usual``,
        ``policy`` (the key by which other commands find it), and ``true_return``, NaN where there
        is no evaluation.

    Raises:
        DamagedFileError: A judgement or an evaluation is missing or damaged.
    """
    evaluations: dict[str, Node] = {}
    for node in done:
        if node.component == "evaluation":
            evaluations.setdefault(node.inputs["policy"].key, node)
    parts = []
    for node in done:
        if node.component != "judgement":
            continue
        store.check(node.key, (JUDGEMENT,))
        with np.load(store.path(node.key) / JUDGEMENT, allow_pickle=False) as stored:
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
            **{name: found[name].ravel() for name in Judgement.names()},
            **{f"{name}_usual": float(found[f"behaviour/{name}"][0]) for name in _USUAL},
            "policy": policy.key,
            "true_return": np.full(shape, np.nan).ravel(),
        }
        if policy.key in evaluations:
            columns["true_return"] = _true_returns(
                evaluations[policy.key], store, found["steps"], found["proximities"]
            ).ravel()
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _true_returns(
    node: Node, store: ArtifactStore, steps: np.ndarray, proximities: np.ndarray
) -> np.ndarray:
    """Mean returns ``[S, G]`` of an evaluation; NaN at proximities that it lacks."""
    store.check(node.key, ("returns.npz",))
    with np.load(store.path(node.key) / "returns.npz", allow_pickle=False) as stored:
        means, at, known = stored["returns"].mean(axis=-1), stored["steps"], stored["lambdas"]
    means = means[np.searchsorted(at, steps)]
    if np.isnan(proximities).all():
        return means
    apart = np.abs(known[None] - proximities[:, None])
    nearest = apart.argmin(axis=1)
    return np.where(apart.min(axis=1) < 1e-6, means[:, nearest], np.nan)
