"""Finds a policy in a store, for the doors that use one."""

import re
from pathlib import Path
from typing import Any

from flows.configuration.checking import SettingsError
from flows.pipeline.errors import TrackingError
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_errors import refusal
from flows.pipeline.tracking.mlflow_setup import import_mlflow

__all__ = ["find_policy"]

_TRAINING = "policy_training"


def find_policy(store: ArtifactStore, run: str) -> dict[str, Any]:
    """The `node.json` of a stored policy.

    Args:
        store: With the artifacts.
        run: Key or name of its node, or the id of its run in MLflow.

    Raises:
        SettingsError: No such run, one that is no policy, or several of that name.
    """
    records = [r for r in store.records() if run in (r.get("key"), r.get("name"))]
    if not records and re.fullmatch(r"[0-9a-f]{32}", run):
        key = _key_in_mlflow(store.root, run)
        records = [store.record(key)] if key and store.complete(key) else []
    if not records:
        raise SettingsError(
            f"run={run}: {store.root} holds no such finished run; give the id of a run in MLflow, "
            "a folder name in its nodes/, or a name such as td3_bc/hopper/seed0."
        )
    if len(records) > 1:
        keys = ", ".join(str(r["key"]) for r in records)
        raise SettingsError(f"run={run} is the name of several runs; give one of the keys {keys}.")
    if records[0]["component"] != _TRAINING:
        raise SettingsError(
            f"run={run} is not a policy but a run of {records[0]['component']}; give a run of "
            f"{_TRAINING}."
        )
    return records[0]


def _key_in_mlflow(root: Path, run: str) -> str | None:
    """The node behind a run of MLflow, None if there is no such run.

    Raises:
        TrackingError: MLflow cannot be used.
    """
    address = StoreAddress(root)
    if address.own and not address.database.exists():
        return None
    mlflow = import_mlflow()
    try:
        client = mlflow.MlflowClient(tracking_uri=address.tracking)
        key: str | None = client.get_run(run).data.tags.get("key")
    except Exception as error:
        if getattr(error, "error_code", "") == "RESOURCE_DOES_NOT_EXIST":
            return None
        raise TrackingError(refusal(error, address)) from None
    return key
