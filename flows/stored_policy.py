"""Finds a policy in a store, for the doors that use one."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError
from components.data.dataset import OfflineDataset
from components.operating.operable import Operable, familiar_frames, newest
from components.policies.policy import Policy
from flows.configuration.checking import SettingsError
from flows.pipeline.errors import TrackingError
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_errors import refusal
from flows.pipeline.tracking.mlflow_setup import import_mlflow

__all__ = ["TRAINING", "find_policy", "open_operable"]

TRAINING = "policy_training"
"""The component whose runs are policies."""

_BEHAVIOUR = "behaviour_policy"  # role of an input, and name of a model
_KEY = re.compile(r"[0-9a-f]{32}")


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
    if records[0]["component"] != TRAINING:
        raise SettingsError(
            f"run={run} is not a policy but a run of {records[0]['component']}; give a run of "
            f"{TRAINING}."
        )
    return records[0]


def open_operable(store: ArtifactStore, record: Mapping[str, Any]) -> Operable:
    """A stored policy with all that operating it takes.

    Args:
        store: With the artifacts.
        record: The `node.json` of the policy.

    Raises:
        DamagedFileError: An artifact is damaged or missing.
    """
    inputs = record["inputs"]
    log = OfflineDataset.open(_folder(store, inputs["dataset"]) / "dataset")
    clone = inputs.get(_BEHAVIOUR) or _clone_of(store, inputs["dataset"])
    behaviour = None if clone is None else newest(Policy.load(_folder(store, clone) / "model"))
    policy = newest(Policy.load(_folder(store, record["key"]) / "policy"))
    return Operable(policy, behaviour, log.card, familiar_frames(log), log)


def _clone_of(store: ArtifactStore, dataset: str) -> str | None:
    """Key of a clone of a dataset's behaviour, if one was fitted."""
    for record in store.records():
        fitted = record.get("component") == "model_fitting" and record["inputs"] == {
            "dataset": dataset
        }
        if fitted and record["config"].get("model") == _BEHAVIOUR:
            return str(record["key"])
    return None


def _folder(store: ArtifactStore, key: object) -> Path:
    """The folder of a finished node, whose key a file has named: it must not be a path.

    Raises:
        DamagedFileError: It is no key, or there is no such node.
    """
    if not isinstance(key, str) or not _KEY.fullmatch(key) or not store.complete(key):
        raise DamagedFileError(f"{store.root} holds no finished run {str(key)[:40]!r}", store.root)
    return store.path(key)


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
