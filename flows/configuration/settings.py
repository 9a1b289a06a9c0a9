"""From conf/ and the command line to checked, frozen settings.

Hydra's compose API joins the files of conf/ with a profile and the overrides; strict pydantic
models check every key and range. Whatever is wrong ends in one sentence that names the valid
choices.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import ConfigDict, Field, ValidationError

from components.algorithms import ALGORITHMS
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.source import source_kind
from components.data.sources.stored_log import StoredLog
from components.environments.mujoco.specifications import ROBOTS
from components.evaluation.real import EvaluationConfig
from components.experts.online import ExpertConfig
from components.models import MODELS
from flows.configuration.checking import SettingsError, build_config, check_group, sentence
from flows.configuration.composition import (
    CONF,
    GROUPS,
    check_keys,
    compose_profile,
    first_line,
    hint,
    merge,
    names_in,
    parse_overrides,
    special_settings,
)
from flows.configuration.sections import (
    AggregationSettings,
    DataSettings,
    EvaluationSettings,
    ExpertsSettings,
    ModelsSettings,
    RunnerSettings,
    Strict,
    TrainingSettings,
    TuningSettings,
)

__all__ = ["ALIASES", "Settings", "SettingsError", "load_settings"]

ALIASES: Mapping[str, str] = {"models": "models.source"}
"""Short keys of the command line and what they stand for; a door may have others."""


class Settings(Strict):
    """A complete, checked configuration.

    Attributes:
        variants: By algorithm, one of its settings and the values it takes one after the other.
        model_words: By model, the first word of the command line that changes a setting of it.
        dataset: Every dataset of conf/dataset by name, with sizes filled in.
        algorithm: Configuration object of every algorithm by name.
        model: Configuration object of every supervised model by name.
        special: Of datasets that have settings of their own, configuration objects by group
            (`algorithm`, `model`; `model_for` by algorithm) and name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    profile_name: str
    datasets: tuple[str, ...]
    algorithms: tuple[str, ...]
    seeds: tuple[int, ...]
    sweep: str | None = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    data: DataSettings
    training: TrainingSettings
    evaluation: EvaluationSettings
    aggregation: AggregationSettings
    runner: RunnerSettings
    models: ModelsSettings
    tuning: TuningSettings
    experts: ExpertsSettings
    variants: dict[str, tuple[str, tuple[float, ...]]]
    model_words: dict[str, str]
    store: Path
    dry_run: bool
    dataset: dict[str, IndustrialSpec | RobotSpec | StoredLog]
    algorithm: dict[str, Any]
    model: dict[str, Any]
    special: dict[str, dict[str, dict[str, Any]]]

    def algorithm_on(self, dataset: str, name: str) -> Any:
        """Configuration object of an algorithm on a dataset."""
        return self.special.get(dataset, {}).get("algorithm", self.algorithm)[name]

    def model_on(self, dataset: str, name: str) -> Any:
        """Configuration object of a supervised model on a dataset."""
        return self.special.get(dataset, {}).get("model", self.model)[name]

    def models_for(self, dataset: str, algorithm: str) -> dict[str, Any]:
        """Configuration objects of the models that an algorithm wants otherwise, by name."""
        found: dict[str, Any] = self.special.get(dataset, {}).get("model_for", {})
        return dict(found.get(algorithm, {}))


def load_settings(overrides: Sequence[str], aliases: Mapping[str, str] = ALIASES) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.
        aliases: Short keys and what they stand for.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    profile = "paper"
    rest = []
    for word in overrides:
        key, equals, value = word.partition("=")
        if not equals or not key or key[0] in "+~":
            raise SettingsError(f"{word!r} is not an override; write key=value, e.g. seeds=[0,1].")
        if key == "profile":
            profile = value
        else:
            rest.append(f"{aliases.get(key, key)}={value}")
    if profile not in names_in("profile"):
        raise SettingsError(
            f"Unknown profile {profile!r}; valid ones are {', '.join(names_in('profile'))}."
            + hint(profile, names_in("profile"))
        )
    groups, chosen = compose_profile(profile)
    base = merge(groups, chosen)
    check_keys(rest, base)
    model_words: dict[str, str] = {}
    for word in rest:
        if word.startswith("model."):
            model_words.setdefault(word.split(".")[1], word)
    try:
        given = parse_overrides(rest)
        values: Any = OmegaConf.to_container(merge(base, given), resolve=True)
        for group in GROUPS:
            check_group(group, values[group])
        special = special_settings([groups, chosen, given])
        return _check(values, special, model_words)
    except OmegaConfBaseException as error:
        raise SettingsError(f"{first_line(error)}; write a plain value.") from error


def _check(
    values: dict[str, Any],
    special: Mapping[str, Mapping[str, Any]],
    model_words: Mapping[str, str],
) -> Settings:
    values["model_words"] = dict(model_words)
    del values["domain"]
    if values["store"] == "":
        raise SettingsError("store= is empty; name a folder, e.g. store=mlruns.")
    for group in ("dataset", "algorithm"):
        values[f"{group}s"] = _select(group, values[f"{group}s"], names_in(group))
    values["seeds"] = _seeds(values["seeds"])
    try:
        data = build_config(DataSettings, "data", values["data"])
        values["dataset"] = {
            name: _spec(name, fields, data) for name, fields in values["dataset"].items()
        }
        kinds = {"algorithm": _algorithm_configs(), "model": _model_configs()}
        for group, known in kinds.items():
            values[group] = {
                name: build_config(known[name], f"{group}.{name}", fields)
                for name, fields in values[group].items()
            }
        values["special"] = {
            dataset: _special_configs(kinds, dataset, own) for dataset, own in special.items()
        }
        sections = (
            ("training", TrainingSettings),
            ("evaluation", EvaluationSettings),
            ("aggregation", AggregationSettings),
            ("runner", RunnerSettings),
            ("models", ModelsSettings),
            ("tuning", TuningSettings),
            ("experts", ExpertsSettings),
        )
        check_group("tuning", values["tuning"])
        values["tuning"]["models"] = _select(
            "model", values["tuning"].get("models"), names_in("model")
        )
        check_group("experts", values["experts"])
        values["experts"] = _experts(values["experts"])
        values |= {name: build_config(kind, name, values[name]) for name, kind in sections}
        values["data"] = data
        values["variants"] = _variants(values)
        settings = Settings(**values)
        EvaluationConfig(**settings.evaluation.model_dump())
    except ValidationError as error:
        raise SettingsError(sentence(error, "")) from error
    except ValueError as error:
        raise SettingsError(str(error)) from error
    _check_snapshots(settings)
    return settings


def _spec(name: str, fields: Any, data: DataSettings) -> IndustrialSpec | RobotSpec | StoredLog:
    """What a dataset is made of, without what its file says about algorithms and models."""
    check_group(f"dataset.{name}", fields)
    own = {k: v for k, v in fields.items() if k not in ("domain", "algorithm", "model")}
    kind = source_kind(own)
    if isinstance(own.get("log"), str):  # a relative folder is one of the project, like conf/
        own["log"] = str(CONF.parent / own["log"])
    known = {field.name for field in dataclasses.fields(kind)}
    sizes = {k: v for k, v in data.model_dump(exclude={"seed"}).items() if k in known}
    spec: IndustrialSpec | RobotSpec | StoredLog = build_config(
        kind, f"dataset.{name}", {"name": name, **own, **sizes}
    )
    return spec


def _special_configs(
    kinds: Mapping[str, Mapping[str, type]], dataset: str, own: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Configuration objects of one dataset's own settings."""

    def built(group: str, path: str, fields: Mapping[str, Any]) -> dict[str, Any]:
        for name in fields:
            if name not in kinds[group]:
                valid = sorted(kinds[group])
                raise SettingsError(
                    f"{path}.{name}: unknown {group}; valid ones are {', '.join(valid)}."
                    + hint(name, valid)
                )
        return {
            name: build_config(kinds[group][name], f"{path}.{name}", value)
            for name, value in fields.items()
        }

    found = {group: built(group, f"{dataset}: {group}", own[group]) for group in kinds}
    wanted = own["model_for"]
    return found | {
        "model_for": {a: built("model", f"{dataset}: model_for.{a}", wanted[a]) for a in wanted}
    }


def _algorithm_configs() -> Mapping[str, type]:
    return {name: module.Config for name, module in ALGORITHMS.items()}


def _model_configs() -> Mapping[str, type]:
    return {name: kind.config for name, kind in MODELS.items()}


def _variants(values: dict[str, Any]) -> dict[str, tuple[str, tuple[float, ...]]]:
    """Takes the options that ask for several policies of one algorithm."""
    penalties = values.pop("mopo_penalties")
    if penalties is None:
        return {}
    if penalties == "sweep":
        penalties = [round(0.1 * k, 1) for k in range(26)]  # thesis 6.3
    chosen = penalties if isinstance(penalties, list) else [penalties]
    numbers = all(isinstance(p, int | float) and not isinstance(p, bool) for p in chosen)
    if not chosen or not numbers or len(set(chosen)) != len(chosen):
        raise SettingsError(
            f"mopo_penalties={penalties} must be null, sweep or a list of different numbers."
        )
    if "mopo" not in values["algorithms"]:
        raise SettingsError(
            "mopo_penalties is given, but mopo is not among the algorithms; add it."
        )
    for penalty in chosen:
        try:
            dataclasses.replace(values["algorithm"]["mopo"], penalty=float(penalty))
        except ValueError as error:
            raise SettingsError(f"mopo_penalties={penalties}: {error}") from error
    return {"mopo": ("penalty", tuple(map(float, chosen)))}


def _check_snapshots(settings: Settings) -> None:
    for dataset, name in product(settings.datasets, settings.algorithms):
        updates = settings.algorithm_on(dataset, name).updates
        if updates < settings.training.snapshots:
            raise SettingsError(
                f"algorithm.{name}.updates={updates} is less than training.snapshots="
                f"{settings.training.snapshots}; raise the one or lower the other."
            )


def _experts(values: Mapping[str, Any]) -> dict[str, Any]:
    """The section of the experts with its names, seeds and training checked."""
    return {
        **values,
        "robots": _select("robot", values.get("robots"), list(ROBOTS)),
        "seeds": _seeds(values.get("seeds")),
        "training": build_config(ExpertConfig, "experts.training", values.get("training")),
    }


def _seeds(chosen: Any) -> list[int]:
    seeds = chosen if isinstance(chosen, list) else [chosen]
    if not seeds or len(set(map(str, seeds))) != len(seeds):
        raise SettingsError(f"seeds={seeds} must be a list of different whole numbers.")
    if any(isinstance(seed, bool) or not isinstance(seed, int) or seed < 0 for seed in seeds):
        raise SettingsError(f"seeds={seeds} must hold whole numbers from 0.")
    return seeds


def _select(group: str, chosen: Any, valid: list[str]) -> list[str]:
    if chosen == "all":
        return valid
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
        raise SettingsError(f"{group}s={names} names one twice.")
    return names
