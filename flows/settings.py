"""From conf/ and the command line to checked, frozen settings.

Hydra's compose API joins the files of conf/ with a profile and the overrides; strict pydantic
models check every key and range. Whatever is wrong ends in one sentence that names the valid
choices.
"""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from components.algorithms import ALGORITHMS
from components.data.catalogue import DatasetSpec
from components.evaluation.real import EvaluationConfig
from components.models import MODELS

__all__ = ["CONF", "Settings", "SettingsError", "load_settings"]

CONF = Path(__file__).resolve().parents[1] / "conf"


class SettingsError(ValueError):
    """Something on the command line or in conf/ is wrong; the message is one sentence."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DataSettings(_Strict):
    """Size and seed of the generated datasets."""

    seed: int = Field(ge=0)
    trajectories: int = Field(ge=2)
    steps: int = Field(ge=1)


class TrainingSettings(_Strict):
    """What training keeps."""

    snapshots: int = Field(ge=1)


class EvaluationSettings(_Strict):
    """The evaluation protocol; the discount belongs to the dataset."""

    trajectories: int = Field(ge=1)
    horizon: int = Field(ge=1)
    lambda_step: float = Field(ge=0.01, le=1)


class AggregationSettings(_Strict):
    """Which policies enter the table."""

    pool_fraction: float = Field(gt=0, le=1)


class RunnerSettings(_Strict):
    """How to run; changes no result."""

    executor: Literal["ray", "serial"]
    cpus: int | None = Field(ge=1)
    threads: int = Field(ge=1)
    device: Literal["auto", "cpu", "cuda"]
    stack: Literal["pair", "algorithm"]


class Settings(_Strict):
    """A complete, checked configuration.

    Attributes:
        dataset: Every dataset of conf/dataset by name, with sizes filled in.
        algorithm: Configuration object of every algorithm by name.
        model: Configuration object of every supervised model by name.
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
    store: Path
    dry_run: bool
    dataset: dict[str, DatasetSpec]
    algorithm: dict[str, Any]
    model: dict[str, Any]


def _names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _hint(word: str, valid: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def load_settings(overrides: Sequence[str]) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.

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
            rest.append(word)
    if profile not in _names("profile"):
        raise SettingsError(
            f"Unknown profile {profile!r}; valid ones are {', '.join(_names('profile'))}."
            + _hint(profile, _names("profile"))
        )
    base = _compose(profile)
    _check_keys(rest, base)
    try:
        return _check(OmegaConf.merge(base, _parse(rest)))  # type: ignore[arg-type]
    except OmegaConfBaseException as error:
        raise SettingsError(f"{_first_line(error)}; write a plain value.") from error


@cache
def _compose(profile: str) -> DictConfig:
    """The files of conf/ joined with a profile; not to be changed by the caller."""
    groups = [
        f"+{group}=[{','.join(_names(group))}]" for group in ("dataset", "algorithm", "model")
    ]
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            # The groups come first, so that the profile's budgets win over their defaults.
            base = compose("groups", overrides=groups)
            chosen = compose("config", overrides=[f"profile={profile}"])
            OmegaConf.set_struct(base, False)
            merged = OmegaConf.merge(base, chosen)
            OmegaConf.set_struct(merged, True)
            return merged  # type: ignore[return-value]
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(_first_line(error)) from error


def _parse(overrides: Sequence[str]) -> DictConfig:
    """Values of overrides by Hydra's grammar, as a nested configuration."""
    parsed = OmegaConf.create({})
    parser = OverridesParser.create()
    for word in overrides:
        try:
            override = parser.parse_override(word)
        except HydraException as error:
            raise SettingsError(
                f"{word!r} cannot be read; write key=value with lists as [a,b]."
            ) from error
        if override.is_sweep_override():
            raise SettingsError(
                f"{override.input_line!r} lists values without brackets; write "
                f"{override.key_or_group}=[...]."
            )
        OmegaConf.update(parsed, override.key_or_group, override.value(), force_add=True)
    return parsed


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _check_keys(overrides: Sequence[str], base: DictConfig) -> None:
    """Name the valid siblings of the first unknown key."""
    for word in overrides:
        if word.startswith("dataset."):
            raise SettingsError(
                f"{word!r}: dataset names hold dots, so their keys cannot be given here; edit "
                "conf/dataset, or select with datasets=[...]."
            )
        node: Any = base
        walked: list[str] = []
        for part in word.partition("=")[0].split("."):
            if not isinstance(node, DictConfig) or part not in node:
                valid = sorted(map(str, node)) if isinstance(node, DictConfig) else []
                place = f" in {'.'.join(walked)}" if walked else ""
                listing = f"; valid keys{place}: {', '.join(valid)}" if valid else ""
                unknown = ".".join([*walked, part])
                raise SettingsError(f"Unknown key {unknown!r}{listing}.{_hint(part, valid)}")
            node = node[part]
            walked.append(part)


def _check(config: DictConfig) -> Settings:
    values: Any = OmegaConf.to_container(config, resolve=True)
    for group in ("dataset", "algorithm", "model"):
        _check_group(group, values[group])
    if values["store"] == "":
        raise SettingsError("store= is empty; name a folder, e.g. store=mlruns.")
    values["datasets"] = _select("dataset", values["datasets"])
    values["algorithms"] = _select("algorithm", values["algorithms"])
    seeds = values["seeds"] if isinstance(values["seeds"], list) else [values["seeds"]]
    if not seeds or len(set(map(str, seeds))) != len(seeds):
        raise SettingsError(f"seeds={seeds} must be a list of different whole numbers.")
    if any(isinstance(seed, bool) or not isinstance(seed, int) or seed < 0 for seed in seeds):
        raise SettingsError(f"seeds={seeds} must hold whole numbers from 0.")
    values["seeds"] = seeds
    try:
        data = _build(DataSettings, "data", values["data"])
        sizes = {"trajectories": data.trajectories, "steps": data.steps}
        values["dataset"] = {
            name: _build(DatasetSpec, f"dataset.{name}", {"name": name, **fields, **sizes})
            for name, fields in values["dataset"].items()
        }
        for group, known in (("algorithm", _algorithm_configs()), ("model", _model_configs())):
            values[group] = {
                name: _build(known[name], f"{group}.{name}", fields)
                for name, fields in values[group].items()
            }
        sections = (
            ("training", TrainingSettings),
            ("evaluation", EvaluationSettings),
            ("aggregation", AggregationSettings),
            ("runner", RunnerSettings),
        )
        values |= {name: _build(kind, name, values[name]) for name, kind in sections}
        values["data"] = data
        settings = Settings(**values)
        EvaluationConfig(**settings.evaluation.model_dump())
    except ValidationError as error:
        raise SettingsError(_sentence(error, "")) from error
    except ValueError as error:
        raise SettingsError(str(error)) from error
    _check_snapshots(settings)
    return settings


def _algorithm_configs() -> Mapping[str, type]:
    return {name: module.Config for name, module in ALGORITHMS.items()}


def _model_configs() -> Mapping[str, type]:
    return {name: kind.config for name, kind in MODELS.items()}


def _check_snapshots(settings: Settings) -> None:
    for name in settings.algorithms:
        updates = settings.algorithm[name].updates
        if updates < settings.training.snapshots:
            raise SettingsError(
                f"algorithm.{name}.updates={updates} is less than training.snapshots="
                f"{settings.training.snapshots}; raise the one or lower the other."
            )


def _select(group: str, chosen: Any) -> list[str]:
    valid = _names(group)
    if chosen == "all":
        return valid
    names = [str(name) for name in (chosen if isinstance(chosen, list) else [chosen])]
    if not names:
        raise SettingsError(f"{group}s=[] selects nothing; valid ones are {', '.join(valid)}.")
    for name in names:
        if name not in valid:
            raise SettingsError(
                f"Unknown {group} {name!r}; valid ones are {', '.join(valid)}, or all."
                + _hint(name, valid)
            )
    if len(set(names)) != len(names):
        raise SettingsError(f"{group}s={names} names one twice.")
    return names


def _check_group(path: str, fields: Any) -> None:
    if not isinstance(fields, Mapping):
        raise SettingsError(f"{path}={fields!r} must be a group of keys, e.g. {path}.KEY=VALUE.")


def _build(kind: type, path: str, fields: Mapping[str, Any]) -> Any:
    """A configuration object, its types and ranges checked."""
    _check_group(path, fields)
    for name, value in fields.items():
        if isinstance(value, bool):  # pydantic would take it for a number
            raise SettingsError(f"{path}.{name}={str(value).lower()}: Input should be no boolean.")
    if issubclass(kind, BaseModel):
        names = list(kind.model_fields)
    else:
        names = [field.name for field in dataclasses.fields(kind)]
    try:
        if issubclass(kind, BaseModel):
            return kind(**fields)
        config = ConfigDict(extra="forbid", allow_inf_nan=False)
        strict = checked_dataclass(kind, config=config, frozen=True)
        checked = TypeAdapter(strict).validate_python(dict(fields))
    except ValidationError as error:
        raise SettingsError(_sentence(error, path, names)) from error
    # Hand on the component's own class: the wrapper is for checking only.
    return kind(**{name: getattr(checked, name) for name in names})


def _sentence(error: ValidationError, path: str, names: Sequence[str] = ()) -> str:
    first = error.errors()[0]
    where = ".".join([path, *map(str, first["loc"])] if path else map(str, first["loc"]))
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"Unknown key {where!r}; valid keys there: {', '.join(names)}."
    reason = first["msg"].removeprefix("Value error, ")
    if not first["loc"] or first["type"] == "value_error":
        return f"{where}: {reason}" if where else reason
    return f"{where}={first['input']!r}: {reason}."
