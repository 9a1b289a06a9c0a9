"""The groups of conf/config.yaml: their keys, types and ranges."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from components.experts.online import ExpertConfig

__all__ = [
    "AggregationSettings",
    "DataSettings",
    "EvaluationSettings",
    "ExpertsSettings",
    "ModelsSettings",
    "RunnerSettings",
    "Strict",
    "TrainingSettings",
    "TuningSettings",
]


class Strict(BaseModel):
    """Knows its keys and takes no others."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DataSettings(Strict):
    """Size and seed of the generated datasets."""

    seed: int = Field(ge=0)
    trajectories: int = Field(ge=2)
    steps: int = Field(ge=1)
    transitions: int = Field(ge=1)


class TrainingSettings(Strict):
    """What training keeps."""

    snapshots: int = Field(ge=1)


class EvaluationSettings(Strict):
    """The evaluation protocol; the discount belongs to the dataset."""

    trajectories: int = Field(ge=1)
    horizon: int = Field(ge=1)
    lambda_step: float = Field(ge=0.01, le=1)


class AggregationSettings(Strict):
    """Which policies enter the table."""

    pool_fraction: float = Field(gt=0, le=1)


class ExpertsSettings(Strict):
    """Which experts are trained; how is in `training`, an `ExpertConfig`."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )

    robots: tuple[str, ...]
    seeds: tuple[int, ...]
    physics: Literal["v3", "v5"]
    episodes: int = Field(ge=1)
    install: bool
    training: ExpertConfig


class RunnerSettings(Strict):
    """How to run; changes no result."""

    executor: Literal["ray", "serial"]
    tracker: Literal["mlflow", "file", "none"]
    cpus: int | None = Field(ge=1)
    threads: int = Field(ge=1)
    device: Literal["auto", "cpu", "cuda"]
    gpu_share: float = Field(gt=0, le=1)
    stack: Literal["pair", "algorithm"]


class ModelsSettings(Strict):
    """Which models policies are trained with."""

    source: Literal["default", "tuned"]
    per_seed: bool
    folder: Path


class TuningSettings(Strict):
    """What a hyperparameter search searches, and how long."""

    models: tuple[str, ...]
    trials: int = Field(ge=1)
