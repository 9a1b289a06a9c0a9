"""Writes into an MLflow run, within the sizes that one call may have."""

import math
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from flows.pipeline.tracking.tracker import Metrics

__all__ = ["DIGEST_LENGTH", "log_anew", "log_batches", "log_datasets", "split_finite"]

NOT_FINITE = "not_finite"
"""Tag of a run with the names of its metrics that are infinite or no number."""

DIGEST_LENGTH = 36
"""Of a data set's digest in MLflow; the rest is cut."""

_CHUNK = {"metrics": 1000, "params": 100, "tags": 100}  # MLflow's limits for one log_batch
_TOGETHER = 1000
_TAG_LENGTH = 5000


def log_batches(
    client: Any,
    run_id: str,
    metrics: Iterable[tuple[Any, ...]] = (),
    params: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Writes any number of entries in few calls.

    Metrics that are no finite number are left out and named in the tag `not_finite`: MLflow's
    databases show an infinite one as 1.8e308, and its charts draw the line there.

    Args:
        client: An MlflowClient.
        run_id: The run.
        metrics: (name, value, milliseconds since 1970, step); a listed model's also with the
            model's id, the name and the digest of its data set, and the run's id.
        params: Parameters by name.
        tags: Tags by name.
    """
    from mlflow.entities import Metric, Param, RunTag

    finite, others = split_finite(metrics)
    tags = dict(tags or {}) | ({NOT_FINITE: others[:_TAG_LENGTH]} if others else {})
    parts: dict[str, list[Any]] = {
        "metrics": [Metric(*metric) for metric in finite],
        "params": [Param(*param) for param in (params or {}).items()],
        "tags": [RunTag(*tag) for tag in tags.items()],
    }
    while any(parts.values()):
        # One call takes 1,000 entries in all.
        batch, room = {}, _TOGETHER
        for name in ("params", "tags", "metrics"):
            batch[name] = parts[name][: min(room, _CHUNK[name])]
            parts[name] = parts[name][len(batch[name]) :]
            room -= len(batch[name])
        client.log_batch(run_id, **batch)


def split_finite(metrics: Iterable[tuple[Any, ...]]) -> tuple[list[tuple[Any, ...]], str]:
    """The metrics that are finite numbers, and the others as a text.

    Args:
        metrics: Each begins with its name and its value.

    Returns:
        Such metrics, and e.g. `loss: inf at 3 of 5 steps, size: nan`.
    """
    finite, points = [], Counter[str]()
    others: dict[str, list[float]] = {}
    for metric in metrics:
        name, value = metric[:2]
        points[name] += 1
        if math.isfinite(value):
            finite.append(metric)
        else:
            others.setdefault(name, []).append(value)
    texts = []
    for name, values in others.items():
        kinds = "/".join(sorted({str(value) for value in values}))
        share = "" if points[name] == 1 else f" at {len(values)} of {points[name]} steps"
        texts.append(f"{name}: {kinds}{share}")
    return finite, ", ".join(texts)


def log_anew(client: Any, run_id: str, metrics: Metrics) -> None:
    """Writes those metrics of a run that it does not have, or has with another value.

    Args:
        client: An MlflowClient.
        run_id: The run, of this sweep or of an earlier one of the same name.
        metrics: Per name (step, value) pairs.
    """
    now = int(1000 * time.time())
    run = client.get_run(run_id)
    new = []
    for name, points in metrics.items():
        known: dict[int, float] = {}
        if name in run.data.metrics:
            if len(points) == 1 and run.data.metrics[name] == points[0][1]:
                continue  # what MLflow shows of it; its history takes a question of its own
            past = client.get_metric_history(run_id, name)
            known = {m.step: m.value for m in sorted(past, key=lambda m: m.timestamp)}
        new += [(name, float(v), now, step) for step, v in points if known.get(step) != v]
    if NOT_FINITE in run.data.tags:
        client.delete_tag(run_id, NOT_FINITE)  # written again if it still holds
    log_batches(client, run_id, metrics=new)


def log_datasets(client: Any, run_id: str, datasets: Sequence[Mapping[str, Any]]) -> None:
    """Names the data sets that a run has read.

    Args:
        client: An MlflowClient.
        run_id: The run.
        datasets: Per data set its `name`, `digest` and `source`.
    """
    if not datasets:
        return
    from mlflow.data.code_dataset_source import CodeDatasetSource
    from mlflow.data.meta_dataset import MetaDataset
    from mlflow.entities import DatasetInput, InputTag

    inputs = [
        DatasetInput(
            MetaDataset(
                source=CodeDatasetSource(tags={"source": str(data.get("source", ""))}),
                name=str(data["name"]),
                digest=str(data["digest"])[:DIGEST_LENGTH],
            )._to_mlflow_entity(),
            [InputTag("mlflow.data.context", "offline-rl")],
        )
        for data in datasets
    ]
    client.log_inputs(run_id, inputs)
