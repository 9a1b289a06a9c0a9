"""The groups of the settings: their keys, types and ranges."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from typing_extensions import TypedDict

from components.data.sources.robots import ROBOTS
from components.experts.config import ExpertConfig
from components.judging.config import JudgeConfig
from components.models.action_stochasticity import StochasticityConfig
from flows.configuration.checking import SettingsError, StrictModel, hint
from flows.configuration.defaults import ALGORITHM_CONFIGS, MODEL_CONFIGS

__all__ = [
    "AggregationSettings",
    "AlgorithmConfigs",
    "DataSettings",
    "ExpertsSettings",
    "JudgingSettings",
    "ModelConfigs",
    "ModelsSettings",
    "RankingSettings",
    "RunnerSettings",
    "Seeds",
    "SpecialSettings",
    "TrainingSettings",
    "TuningSettings",
    "selected",
    "selection",
]


def selected(group: str, chosen: Any, valid: Sequence[str]) -> list[str]:
    """Chosen names; `all` stands for every valid one.

    Raises:
        SettingsError: No name, an unknown one, or one twice.
    """
    if chosen == "all":
        return list(valid)
    names = [str(name) for name in (chosen if isinstance(chosen, list) else [chosen])]
    if not names:
        raise SettingsError(f"{group}s=[] selects nothing; valid ones are {', '.join(valid)}.")
    for name in names:
        if name not in valid:
            raise SettingsError(
                f"Unknown {group} {name!r}; valid ones are {', '.join(valid)}, or all."
                + hint(name, valid)
            )
    if len(set(names)) != len(names):
        raise SettingsError(f"{group}s={names} names one twice; give each name once.")
    return names


def selection(group: str, valid: Iterable[str]) -> BeforeValidator:
    """A validator that turns chosen names into a list, see `selected`."""
    names = list(valid)
    return BeforeValidator(lambda chosen: selected(group, chosen, names))


def _different_seeds(chosen: Any) -> list[int]:
    seeds = chosen if isinstance(chosen, list) else [chosen]
    if not seeds or len(set(map(str, seeds))) != len(seeds):
        raise SettingsError(f"seeds={seeds} must be a list of different whole numbers.")
    if any(isinstance(seed, bool) or not isinstance(seed, int) or seed < 0 for seed in seeds):
        raise SettingsError(f"seeds={seeds} must hold whole numbers from 0.")
    return seeds


_PACKS = ("auto", "none", "pair", "algorithm")


def _together(pack: Any) -> Any:
    if pack not in _PACKS and not (type(pack) is int and pack >= 1):
        raise SettingsError(
            f"pack={pack} must be {', '.join(_PACKS)} or a number of datasets, at least 1."
        )
    return pack


def _time_of_day(time: Any) -> Any:
    if time is not None and not re.fullmatch(r"([01]?\d|2[0-3]):[0-5]\d", str(time), re.ASCII):
        raise SettingsError(f"until={time} is no time of day; write hours:minutes, e.g. 07:00.")
    return time


Seeds = Annotated[tuple[int, ...], BeforeValidator(_different_seeds)]

AlgorithmConfigs = TypedDict("AlgorithmConfigs", ALGORITHM_CONFIGS)  # type: ignore[misc]
"""A configuration object of every algorithm."""

ModelConfigs = TypedDict("ModelConfigs", MODEL_CONFIGS)  # type: ignore[misc]
"""A configuration object of every supervised model."""

_SomeModels = TypedDict("_SomeModels", MODEL_CONFIGS, total=False)  # type: ignore[misc]
_ModelsOfSome = TypedDict(  # type: ignore[misc]
    "_ModelsOfSome", dict.fromkeys(ALGORITHM_CONFIGS, _SomeModels), total=False
)


class SpecialSettings(StrictModel):
    """Settings on a dataset that changes some for itself.

    Attributes:
        algorithm: Configuration object of every algorithm, by name.
        model: Configuration object of every supervised model, by name.
        model_for: By algorithm, configuration objects of the models that differ for it.
    """

    algorithm: AlgorithmConfigs
    model: ModelConfigs
    model_for: _ModelsOfSome


class DataSettings(StrictModel):
    """Size and seed of the generated datasets."""

    seed: int = Field(ge=0)
    trajectories: int = Field(ge=2)
    steps: int = Field(ge=1)
    transitions: int = Field(ge=1)


class TrainingSettings(StrictModel):
    """What a training run keeps."""

    snapshots: int = Field(ge=1)


class AggregationSettings(StrictModel):
    """Which policies enter the table."""

    pool_fraction: float = Field(gt=0, le=1)


class ExpertsSettings(StrictModel):
    """Which experts are trained and how."""

    robots: Annotated[tuple[str, ...], selection("robot", ROBOTS)]
    seeds: Seeds
    physics: Literal["v3", "v5"]
    episodes: int = Field(ge=1)
    discount: float = Field(gt=0, le=1)
    install: bool
    training: ExpertConfig


class RunnerSettings(StrictModel):
    """How to run; none of this changes a result."""

    executor: Literal["ray", "serial"]
    tracker: Literal["mlflow", "file", "none"]
    cpus: int | None = Field(ge=1)
    threads: int = Field(ge=1)
    device: Literal["auto", "cpu", "cuda"]
    gpu_share: float = Field(gt=0, le=1)
    precision: Literal["highest", "high", "medium"]
    pack: Annotated[Literal["auto", "none", "pair", "algorithm"] | int, BeforeValidator(_together)]
    repair: Literal["recompute", "refuse"]
    max_hours: float | None = Field(gt=0)
    until: Annotated[str | None, BeforeValidator(_time_of_day)]


class ModelsSettings(StrictModel):
    """Which models policies are trained with."""

    source: Literal["default", "tuned"]
    per_seed: bool
    folder: Path


class TuningSettings(StrictModel):
    """Models and number of trials of a hyperparameter search."""

    models: Annotated[tuple[str, ...], selection("model", MODEL_CONFIGS)]
    trials: int = Field(ge=1)


class JudgingSettings(StrictModel):
    """How policies are judged from their log alone.

    Attributes:
        policies: Which are: `auto`, those of logs without a system; `all`; or `none`.
        held_out: Share of a log's episodes that judges learn from and policies do not, the last
            ones.
        snapshots: Number of a run's last snapshots that are judged.
        estimates: How they are judged.
    """

    policies: Literal["auto", "all", "none"]
    held_out: float = Field(gt=0, lt=1)
    snapshots: int = Field(ge=1)
    estimates: JudgeConfig


class RankingSettings(StrictModel):
    """How datasets are ranked.

    Attributes:
        floor: Return that none falls below; None: the system's, or else a log's own least return.
        report: Name of the sweep whose policies tell the true improvement; None: the only one.
        algorithm: Whose improvement is shown; None: MOOSE's, as in the thesis, or else the first.
        stochasticity: How the spread of actions is fitted.
    """

    floor: float | None
    report: str | None
    algorithm: str | None
    stochasticity: StochasticityConfig
