"""The schema of all settings: nested groups, checked when they are made."""

import dataclasses
import math
import re
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo, field_validator, model_validator

from components.data.sources.source import SOURCE_FIELDS, DatasetSource, source_kind
from components.evaluation.protocol import EvaluationProtocol
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.composition import DEVIATIONS
from flows.configuration.defaults import ALGORITHM_CONFIGS
from flows.configuration.files import CONF
from flows.configuration.sections import (
    AggregationSettings,
    AlgorithmConfigs,
    DataSettings,
    ExpertsSettings,
    JudgingSettings,
    ModelConfigs,
    ModelsSettings,
    RankingSettings,
    RunnerSettings,
    Seeds,
    SpecialSettings,
    TrainingSettings,
    TuningSettings,
    selection,
)

__all__ = ["Settings"]


def _penalties(chosen: Any) -> tuple[float, ...] | None:
    """Checked penalties; MOPO trains a policy for each."""
    if chosen is None:
        return None
    if chosen == "sweep":
        chosen = [round(0.1 * k, 1) for k in range(26)]  # thesis 6.3
    penalties = chosen if isinstance(chosen, list) else [chosen]
    numbers = all(isinstance(p, int | float) and not isinstance(p, bool) for p in penalties)
    if not numbers or len(set(penalties)) != len(penalties) or not penalties:
        raise SettingsError(
            f"mopo_penalties={chosen} must be null, sweep or a list of different numbers."
        )
    if not all(0 <= p < math.inf for p in penalties):
        raise SettingsError(f"mopo_penalties={chosen} must hold finite numbers from 0.")
    return tuple(map(float, penalties))


def _varied(chosen: Any) -> Any:
    """Checked lists of values, by algorithm and setting."""
    for name, fields in chosen.items() if isinstance(chosen, Mapping) else ():
        for setting, values in fields.items() if isinstance(fields, Mapping) else ():
            if not isinstance(values, list | tuple) or not values:
                raise SettingsError(
                    f"variants.{name}.{setting}={values} must be a list of values, e.g. [0.1,0.3]."
                )
    return chosen


def _sweep_name(name: Any) -> Any:
    if name is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", str(name)):
        shown = name if len(str(name)) <= 40 else f"{str(name)[:40]}..."
        raise SettingsError(
            f"sweep={shown!r} names a folder and must be at most 100 letters of a to z, digits, "
            "'.', '_' and '-', of which the first is a letter or a digit."
        )
    return name


def _source(name: str, fields: Any, data: DataSettings) -> DatasetSource:
    """The source of a dataset, without the settings of algorithms and models in its file."""
    path = f"dataset.{name}"
    if not isinstance(fields, Mapping):
        raise SettingsError(f"{path}={fields!r} must be a group of keys, e.g. {path}.KEY=VALUE.")
    own = {k: v for k, v in fields.items() if k not in ("domain", *DEVIATIONS)}
    if not own.keys() & set(SOURCE_FIELDS):
        raise SettingsError(
            f"{path} names no source: give `log` (a folder that flows.import_log has filled), "
            "`robot`, `goals` (of the 2-D world) or `controller`."
        )
    kind = source_kind(own)
    if isinstance(own.get("log"), str):  # a relative folder is one of the project, like conf/
        own["log"] = str(CONF.parent / Path(own["log"]).expanduser())
    known = {field.name for field in dataclasses.fields(kind)}
    sizes = {k: v for k, v in data.model_dump(exclude={"seed"}).items() if k in known}
    source: DatasetSource = build_config(kind, path, {"name": name, **own, **sizes})
    return source


class Settings(StrictModel):
    """A complete, checked configuration.

    Attributes:
        dataset: Source of every chosen dataset by name, with sizes filled in.
        mopo_penalties: Penalties for each of which MOPO trains a policy; None for its own alone.
        variants: By algorithm and setting, the values for each of which a policy is trained.
        algorithm: Configuration object of every algorithm by name.
        model: Configuration object of every supervised model by name.
        special: Settings on the datasets that change some for themselves, by dataset.
        model_overrides: By model, the first override on the command line of one of its settings.
        notes: Sentences about files of conf/ that are not used.
    """

    profile_name: str
    data: DataSettings
    dataset: dict[str, Any]
    datasets: tuple[str, ...]
    algorithms: Annotated[tuple[str, ...], selection("algorithm", ALGORITHM_CONFIGS)]
    seeds: Seeds
    mopo_penalties: Annotated[tuple[float, ...] | None, BeforeValidator(_penalties)]
    variants: Annotated[dict[str, dict[str, tuple[Any, ...]]], BeforeValidator(_varied)]
    sweep: Annotated[str | None, BeforeValidator(_sweep_name)]
    training: TrainingSettings
    evaluation: EvaluationProtocol
    aggregation: AggregationSettings
    models: ModelsSettings
    tuning: TuningSettings
    ranking: RankingSettings
    judging: JudgingSettings
    experts: ExpertsSettings
    runner: RunnerSettings
    store: StoreFolder
    dry_run: bool
    yes: bool
    show_settings: bool
    algorithm: AlgorithmConfigs
    model: ModelConfigs
    special: dict[str, SpecialSettings]
    model_overrides: dict[str, str]
    notes: tuple[str, ...]

    @field_validator("dataset")
    @classmethod
    def _sources(cls, files: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "data" not in info.data:  # invalid itself
            return {}
        return {n: _source(n, fields, info.data["data"]) for n, fields in files.items()}

    @field_validator("special", mode="before")
    @classmethod
    def _own_settings(cls, special: Mapping[str, Any]) -> dict[str, Any]:
        # Domains are checked first, so that their mistakes are not reported as a dataset's.
        built = {place: build_config(SpecialSettings, place, own) for place, own in special.items()}
        group = "dataset."
        return {p.removeprefix(group): own for p, own in built.items() if p.startswith(group)}

    @model_validator(mode="after")
    def _check_penalties(self) -> "Settings":
        if self.mopo_penalties and "mopo" not in self.algorithms:
            raise SettingsError(
                "mopo_penalties is given, but mopo is not among the algorithms; add it."
            )
        return self

    @model_validator(mode="after")
    def _check_variants(self) -> "Settings":
        for name in self.variants:
            if name not in self.algorithms:
                raise SettingsError(
                    f"variants.{name} is given, but {name} is not among the algorithms; add it."
                )
        for dataset, name in product(self.datasets, self.variants):
            self.varied_on(dataset, name)
        return self

    @model_validator(mode="after")
    def _check_snapshots(self) -> "Settings":
        for dataset, name in product(self.datasets, self.algorithms):
            updates = self.algorithm_on(dataset, name).updates
            if updates < self.training.snapshots:
                raise SettingsError(
                    f"algorithm.{name}.updates={updates} is less than training.snapshots="
                    f"{self.training.snapshots}; raise the updates or lower the snapshots."
                )
        return self

    def varied_on(self, dataset: str, name: str) -> list[tuple[str, Any, Any]]:
        """What is trained in place of an algorithm's own settings on a dataset.

        Returns:
            Setting, value and configuration object; settings are varied one at a time. Empty if
            none is.
        """
        penalties = {"penalty": self.mopo_penalties} if self.mopo_penalties else {}
        wanted = self.variants.get(name, {}) | (penalties if name == "mopo" else {})
        config = self.algorithm_on(dataset, name)
        own = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
        return [
            (key, value, build_config(type(config), f"variants.{name}", own | {key: value}))
            for key, values in wanted.items()
            for value in values
        ]

    def algorithm_on(self, dataset: str, name: str) -> Any:
        """Configuration object of an algorithm on a dataset."""
        own = self.special.get(dataset)
        return (own.algorithm if own else self.algorithm)[name]

    def model_on(self, dataset: str, name: str) -> Any:
        """Configuration object of a supervised model on a dataset."""
        own = self.special.get(dataset)
        return (own.model if own else self.model)[name]

    def models_for(self, dataset: str, algorithm: str) -> dict[str, Any]:
        """Configuration objects of the models that differ for an algorithm, by name."""
        own = self.special.get(dataset)
        return dict(own.model_for.get(algorithm, {})) if own else {}
