"""Writes into an MLflow run, within the sizes that one call may have."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["log_batches", "log_datasets"]

_CHUNK = {"metrics": 1000, "params": 100, "tags": 100}  # MLflow's limits for one log_batch
_DIGEST_LENGTH = 36  # MLflow's limit


def log_batches(
    client: Any,
    run_id: str,
    metrics: Iterable[tuple[str, float, int, int]] = (),
    params: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Writes any number of entries in few calls.

    Args:
        client: An MlflowClient.
        run_id: The run.
        metrics: (name, value, milliseconds since 1970, step).
        params: Parameters by name.
        tags: Tags by name.
    """
    from mlflow.entities import Metric, Param, RunTag

    parts: dict[str, list[Any]] = {
        "metrics": [Metric(*metric) for metric in metrics],
        "params": [Param(*param) for param in (params or {}).items()],
        "tags": [RunTag(*tag) for tag in (tags or {}).items()],
    }
    for name, entries in parts.items():
        for at in range(0, len(entries), _CHUNK[name]):
            client.log_batch(run_id, **{name: entries[at : at + _CHUNK[name]]})


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
                digest=str(data["digest"])[:_DIGEST_LENGTH],
            )._to_mlflow_entity(),
            [InputTag("mlflow.data.context", "offline-rl")],
        )
        for data in datasets
    ]
    client.log_inputs(run_id, inputs)
