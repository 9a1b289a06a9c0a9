"""Records an exported policy as a model in MLflow, beside the run of its training."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx

from components.policies.portable_files import CARD
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_setup import import_mlflow

__all__ = ["log_policy"]

_CODE: Final = Path(__file__).with_name("served_policy.py")
_PACKAGES: Final = ("mlflow", "numpy", "onnxruntime")
"""What a served policy needs."""
_PARAMETERS: Final = {
    "proximity": ("double", 0.0),  # as it was always done, until somebody asks for more
    "noise": ("long", None),
}
"""Type and default of the parameter behind an input of the file."""
_NAMES: Final = {"noise": "seed"}


def log_policy(
    experiment: MlflowExperiment, file: Path, key: str, name: str, example: np.ndarray
) -> str:
    """Record a model with its signature, an input example, and its parameters.

    Args:
        experiment: Where the runs are.
        file: The exported policy, ONNX.
        key: Of the policy's node; the model becomes an output of its run if there is one.
        name: Of the model.
        example: `[B, H, F]` recorded histories.

    Returns:
        The model's id.

    Raises:
        TrackingError: MLflow cannot be used.
    """
    [text] = [p.value for p in onnx.load(file).metadata_props if p.key == CARD]
    card = json.loads(text)
    with experiment.writing(), _current(experiment) as mlflow:
        found = f"attributes.status = 'FINISHED' and tags.key = '{key}' and tags.role = 'node'"
        run = next(experiment.search(found), None)
        model = mlflow.models.Model.log(
            None,
            mlflow.pyfunc,
            name=name,
            run_id=run.info.run_id if run else None,
            tags={"key": key, "algorithm": card["algorithm"], "dataset": card["dataset"]},
            python_model=str(_CODE),
            artifacts={"policy": str(file)},
            signature=_signature(card),
            input_example=(example, _defaults(card)) if _defaults(card) else example,
            pip_requirements=[f"{package}=={version(package)}" for package in _PACKAGES],
            metadata=card,
        )
    return str(model.model_id)


_INHERITED = ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_ID")
"""What MLflow writes into the environment, so that processes started later would use it."""


@contextmanager
def _current(experiment: MlflowExperiment) -> Iterator[Any]:
    """MLflow, with the experiment as the one that its functions without a client use."""
    mlflow = import_mlflow()
    before = {name: os.environ.get(name) for name in _INHERITED}
    mlflow.set_tracking_uri(experiment.address.tracking)
    try:
        mlflow.set_experiment(experiment_id=experiment.id)
        yield mlflow
    finally:
        mlflow.set_tracking_uri(None)  # what the environment says
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _signature(card: Mapping[str, Any]) -> Any:
    from mlflow.models import ModelSignature
    from mlflow.types import ParamSchema, ParamSpec, Schema, TensorSpec

    def tensor(of: Mapping[str, Any]) -> TensorSpec:
        return TensorSpec(np.dtype(of["dtype"]), (-1, *of["shape"][1:]))

    params = [
        ParamSpec(_NAMES.get(name, name), *_PARAMETERS[name])
        for name in card["inputs"]
        if name in _PARAMETERS
    ]
    return ModelSignature(
        inputs=Schema([tensor(card["inputs"]["history"])]),
        outputs=Schema([tensor(card["output"])]),
        params=ParamSchema(params) if params else None,
    )


def _defaults(card: Mapping[str, Any]) -> dict[str, Any]:
    return {
        _NAMES.get(name, name): default
        for name, (_, default) in _PARAMETERS.items()
        if name in card["inputs"] and default is not None
    }
