"""Where the judged policies of a sweep lead, from the stored judgements."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd

from components.data.card import DatasetCard
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore
from flows.tasks.judging import JUDGEMENT

__all__ = ["expected_frames"]

_CARD: Final = "dataset/card.json"


def expected_frames(done: Sequence[Node], store: ArtifactStore) -> pd.DataFrame:
    """Where judged policies of finished nodes lead, as far as their ensembles tell.

    Args:
        done: The finished nodes of a sweep.
        store: With their artifacts.

    Returns:
        A row per policy and column of the state, in the units of the log: ``dataset``,
        ``algorithm`` (of the variant), ``seed``, ``step``, ``proximity`` (NaN where it is not
        taken), ``feature``, ``low`` and ``high`` (1st and 99th percentile), ``least`` and
        ``greatest`` of the judges' part of the log, ``held_low`` and ``held_high`` (share of the
        steps that the ensemble is held at its least or greatest value), and ``..._usual``, these
        shares under the behaviour policy. Judgements of older versions have none.

    Raises:
        DamagedFileError: A judgement or the card of its log is missing or damaged.
    """
    parts = []
    for node in done:
        if node.component != "judgement":
            continue
        log = node.inputs["dataset"].key
        store.check(node.key, (JUDGEMENT,))
        with np.load(store.path(node.key) / JUDGEMENT, allow_pickle=False) as stored:
            if "held" not in stored or np.isnan(stored["frames"]).all():
                continue
            ends, logged = stored["frames"], stored["logged_frames"]
            held, usually = stored["held"], stored["held_usually"]
            steps, proximities = stored["steps"], stored["proximities"]
        store.check(log, (_CARD,))
        features = DatasetCard.load(store.path(log) / _CARD).frame_features
        at = np.indices(ends[:, :, 0].shape).reshape(3, -1)
        parts.append(
            pd.DataFrame(
                {
                    "dataset": node.tags["dataset"],
                    "algorithm": node.inputs["policy"].name.split("/", 1)[0],
                    "seed": int(node.tags["seed"]),
                    "step": steps[at[0]],
                    "proximity": proximities[at[1]],
                    "feature": np.asarray(features)[at[2]],
                    "low": ends[:, :, 0].ravel(),
                    "high": ends[:, :, 1].ravel(),
                    "least": logged[0][at[2]],
                    "greatest": logged[1][at[2]],
                    "held_low": held[:, :, 0].ravel(),
                    "held_high": held[:, :, 1].ravel(),
                    "held_low_usual": usually[0][at[2]],
                    "held_high_usual": usually[1][at[2]],
                }
            )
        )
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
