"""Judges policies by a part of their log that they have not learned from."""

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from components.aggregation.selection import DEFAULT_SCORE, ESTIMATES, scored
from components.data.assembly import divided
from components.data.dataset import OfflineDataset
from components.data.sources.held_log import HeldLog
from components.judging.judged import JudgedPolicies
from components.judging.judgement import judge as judge_policies
from components.training.memory import keep_freed_memory
from flows.configuration.composition import base_layers
from flows.configuration.given import settings_of
from flows.configuration.plants import settings_of_log
from flows.configuration.schema import Settings
from flows.planning.judging import JUDGE_MODELS, JUDGE_SEED
from flows.planning.sizes import check_size, suits
from proximity_bench.datasets import PROFILE
from proximity_bench.policies import Policy
from proximity_bench.progress import progress_bars
from proximity_bench.training import chosen_device, fit_model

__all__ = ["judge", "split"]


def split(log: OfflineDataset, held_out: float = 0.3) -> tuple[OfflineDataset, OfflineDataset]:
    """Divide a log: the first episodes to learn from, the last ones to judge by.

    Args:
        log: Of at least two episodes; with four or more, both parts have two at least.
        held_out: Share of the episodes in the second part.

    Raises:
        ValueError: The share is outside (0, 1), or there is a single episode.
    """
    return divided(log, held_out)


def judge(
    policies: Policy | Sequence[Policy],
    log: OfflineDataset,
    *,
    models: Mapping[str, Mapping[str, Any]] | None = None,
    device: str = "auto",
    progress: bool = True,
    **settings: Any,
) -> pd.DataFrame:
    """Estimate what policies are worth, without a system, from a log they have not learned from.

    Their newest snapshots are judged as at the end of a sweep, see docs/judging.md.

    Args:
        policies: One or several, of equal frames and actions.
        log: The second part of :func:`split`, or another log of the same plant.
        models: By model (``behaviour_policy``, ``recurrent_ensemble``), settings of its fit.
        device: "cpu", "cuda", or "auto", a GPU where there is one.
        progress: Whether to show bars, one for each fit.
        settings: Of the judges, e.g. ``updates=500`` of the critics or ``proximity_step=0.05``.

    Returns:
        A row a policy and proximity, the best first: ``algorithm``, ``seed``, ``step``,
        ``proximity``, ``score`` (the gain over the log's behaviour policy, less a price for steps
        outside of the log), all estimates, and those of the behaviour policy as ``NAME_usual``.

    Raises:
        ValueError: An unknown setting, or a log that does not suit; one sentence.
    """
    several = [policies] if isinstance(policies, Policy) else list(policies)
    if not several or not all(isinstance(policy, Policy) for policy in several):
        raise ValueError("Nothing to judge; give a policy of pb.train or pb.load, or several.")
    name = log.card.name
    chosen = _settings(log, models or {}, settings)
    for policy in several:
        if policy.features != log.card.frame_features:
            raise ValueError(
                f"{policy!r} sees {', '.join(policy.features)}, but {name} logs "
                f"{', '.join(log.card.frame_features)}; judge it by a log of its own plant."
            )
        if policy.log is not None and policy.log.digest == log.card.digest:
            warnings.warn(
                f"{policy!r} has learned from this very log, so that its estimates flatter it; "
                "judge it by the second part of pb.split.",
                stacklevel=2,
            )
    where = chosen_device(device)
    keep_freed_memory()
    estimates = chosen.judging.estimates
    configs = {model: chosen.model_on(name, model) for model in JUDGE_MODELS}
    judged = [
        JudgedPolicies.of(one.at(one.steps[-1]).stack, estimates.proximities) for one in several
    ]
    with (
        tempfile.TemporaryDirectory(prefix="proximity_bench-") as folder,
        progress_bars(progress) as begin,
    ):
        fitted = {
            model: fit_model(model, config, log, where, Path(folder), begin, JUDGE_SEED)
            for model, config in configs.items()
            if suits(chosen, name, config)
        }
        behaviour = fitted["behaviour_policy"]
        usual, *found = judge_policies(
            log,
            fitted.get("recurrent_ensemble"),
            behaviour,
            [JudgedPolicies.of(behaviour, ()), *judged],
            [None] * (1 + len(judged)),
            estimates,
            where,
            names=["behaviour", *map(repr, several)],
            progress=begin("fitted_q"),
        )
    rows = [
        pd.DataFrame(
            {
                "algorithm": policy.algorithm,
                "seed": policy.seed,
                "step": policy.steps[-1],
                "proximity": np.asarray(one.proximities),
                **judgement.estimates,
                **{f"{estimate}_usual": getattr(usual, estimate)[0] for estimate in ESTIMATES},
            }
        )
        for policy, one, judgement in zip(several, judged, found, strict=True)
    ]
    table = scored(pd.concat(rows, ignore_index=True)).drop(columns="promised")
    table.insert(4, "score", table[f"score_{DEFAULT_SCORE}"])
    return table.sort_values("score", ascending=False, kind="stable", ignore_index=True)


def _settings(
    log: OfflineDataset, models: Mapping[str, Mapping[str, Any]], settings: Mapping[str, Any]
) -> Settings:
    """Checked settings of the judges and their models."""
    name, known = log.card.name, base_layers(PROFILE).base["dataset"]
    own = {"model": {model: dict(fields) for model, fields in models.items()}}
    given = {
        "datasets": [name],
        "dataset": {
            name: own if name in known else {"log": "", **settings_of_log(log.card), **own}
        },
        "judging": {"estimates": dict(settings)},
    }
    chosen = settings_of(PROFILE, given, {})
    source = HeldLog.of(log)
    check_size(name, source)
    return chosen.model_copy(update={"dataset": {name: source}})
